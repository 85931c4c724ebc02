"""Store the measured sizes in a JSON file, so that an interrupted run can be continued."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from middleware.errors import BadSetting
from sim.team.metric import Metric
from sim.team.scale.measurement import SizeResult, SurveySettings


class MeasurementFile:
    """The sizes measured with ``settings``, in the file ``path``."""

    def __init__(self, path: Path, settings: SurveySettings) -> None:
        self._path = path
        self._new_path = path.with_suffix(".new")
        self._settings = settings
        self.sizes: dict[int, SizeResult] = {}

    def prepare(self) -> None:
        """Create the folder, and check that a file can be written there; raises ``BadSetting``."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._new_path.touch()
            self._new_path.unlink()
        except OSError as error:
            problem = f"cannot write {error.filename}: {error.strerror}"
            raise BadSetting("command line", "--out", problem, "choose a folder to which you can write") from error

    def read(self) -> None:
        """Read the file; raises ``BadSetting`` if it is invalid or was measured with other settings."""
        try:
            content = json.loads(self._path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return
        except (OSError, ValueError) as error:
            raise self._make_error(str(error)) from error
        if not isinstance(content, dict) or not isinstance(content.get("sizes"), dict):
            raise self._make_error("it contains no sizes")
        if content.get("digest") != self._settings.digest():
            raise self._make_error(f"it was measured with other settings: {content.get('settings')}")
        try:
            self.sizes = {int(nodes): _parse_size(int(nodes), size) for nodes, size in content["sizes"].items()}
        except (TypeError, ValueError, KeyError) as error:
            raise self._make_error(f"it contains an invalid size: {error}") from error

    def add(self, result: SizeResult) -> None:
        """Add a size, and replace the file atomically."""
        self.sizes[result.nodes] = result
        content = {
            "digest": self._settings.digest(),
            "settings": asdict(self._settings),
            "sizes": {str(nodes): _encode_size(self.sizes[nodes]) for nodes in sorted(self.sizes)},
        }
        self._new_path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        os.replace(self._new_path, self._path)

    def _make_error(self, problem: str) -> BadSetting:
        return BadSetting(str(self._path), "", f"cannot be used: {problem}", "move it away, or name another --out")


def _encode_size(result: SizeResult) -> dict[str, Any]:
    return {
        "figures": [metric.to_json() for metric in result.metrics],
        "violations": result.violations,
        "hash": result.hash,
        "cpu": round(result.cpu, 1),
    }


def _parse_size(nodes: int, content: dict[str, Any]) -> SizeResult:
    figures = [Metric(**fields) for fields in content["figures"]]
    return SizeResult(nodes, figures, list(content["violations"]), str(content["hash"]), float(content["cpu"]))
