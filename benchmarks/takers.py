"""Check under faults that many takers confirm each tuple at most once and lose no tuple (virtual time, from a seed).

``python -m benchmarks.takers --tuples 10000 --takers 8 --loss 0.0-0.5`` runs complete nodes on a switchboard that loses
datagrams. Meanwhile nodes are killed and return, and links are cut. The command prints a table, and exits with 1 on a
violation.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter

from sim.team.takers.shared_store import SharedStoreTrial
from sim.team.takers.trial import TakingTrial


def main(arguments: list[str] | None = None) -> int:
    """Run trials and print their results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.takers", description=__doc__.partition("\n")[0])
    parser.add_argument("--tuples", type=int, default=1000, help="number of tuples in all trials")
    parser.add_argument("--takers", type=int, default=8, help="number of takers in each trial")
    parser.add_argument("--nodes", type=int, default=12, help="number of nodes in each trial")
    parser.add_argument("--loss", default="0.0-0.5", help="share of lost datagrams, or a range of shares")
    parser.add_argument("--trials", type=int, default=6, help="number of trials, from the lowest loss to the highest")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first trial")
    parser.add_argument(
        "--light", action="store_true", help="do not replicate records: checks only the councils, much faster"
    )
    parser.add_argument("--calm", action="store_true", help="kill no nodes and cut no links")
    args = parser.parse_args(arguments)
    kind = SharedStoreTrial if args.light else TakingTrial
    low, _, high = args.loss.partition("-")
    least, most = float(low), float(high or low)
    print("seed  loss  churn  tuples  confirmed  twice  lost  seen again  simulated s  datagrams/tuple  real s")
    wrong: list[str] = []
    for number in range(args.trials):
        loss = least + (most - least) * number / max(1, args.trials - 1)
        started_at = time.monotonic()
        tuples = args.tuples * (number + 1) // args.trials - args.tuples * number // args.trials
        trial = kind(args.seed + number, tuples, loss, not args.calm, args.takers, args.nodes)
        sent = trial.switchboard.counters["sent"]
        trial.run_trial()
        found = trial.find_violations()
        trial.stop()
        broken = Counter(line[:2] for line in found)
        confirmed = len(trial.recorder.tuples) - len(trial.recorder.list_undecided())
        print(
            f"{trial.seed:4d}  {loss:4.2f}  {'no' if args.calm else 'yes':>5}  {tuples:6d}  {confirmed:9d}"
            f"  {broken['T1']:5d}  {broken['T2'] + broken['T5']:4d}  {broken['T3']:10d}"
            f"  {trial.clock.seconds():11.0f}  {(trial.switchboard.counters['sent'] - sent) / max(1, tuples):15.0f}"
            f"  {time.monotonic() - started_at:6.0f}",
            flush=True,
        )
        wrong += [f"seed {trial.seed}, loss {loss:.2f}: {text}" for text in found]
    for text in wrong[:20]:
        print(text)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
