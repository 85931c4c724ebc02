// The page: every panel that there is, one stream in, and the model that all of them read.
import "./header.js";
import "./devices.js";
import "./groups.js";
import "./cameras.js";
import "./map.js";
import "./tasks.js";
import "./events.js";
import "./views.js";
import "./keep.js";
import { ask, get, open } from "./link.js";
import { model, take } from "./model.js";
import { go, start, tell } from "./shell.js";

function onEvent(event, data) {
  if (event === "link" && data === model.link) return;
  take(event, data);
  // Panels read the model: to them a change is a state like any other.
  tell(event === "change" ? "state" : event);
  // Another node may have other parts.
  if (event === "link" && data === "live") get("node").then(({ has }) => onEvent("has", has), () => {});
}

start({ model, get, ask, go });
open({ onEvent });
