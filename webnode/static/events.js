// Events: the changes that this node observed in the team, all or by kind.
import { at, words } from "./element.js";
import { listEntries, since } from "./history.js";

const KINDS = {
  all: () => true,
  faults: ({ kind }) => ["fault", "gone", "back", "takeover", "handover", "halt"].includes(kind),
  tasks: ({ kind }) => ["task", "agreed", "takeover", "handover"].includes(kind),
  messages: ({ kind }) => kind === "message",
};

export function make(root, { model }) {
  const show = () => {
    const entries = model.events.filter(KINDS[at("event-kind").value]);
    words(at("events-since"), `${model.node ? `Observed by ${model.node}` : "Observed"} ${since(model.events)}`.trim());
    listEntries(at("events"), entries);
  };
  at("event-kind").addEventListener("change", show);
  return {
    update(_, event) {
      if (["", "event", "state"].includes(event)) show();
    },
  };
}
