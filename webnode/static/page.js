// The page: every panel that there is, one stream in, and the model that all of them read.
import "./header.js";
import "./halt.js";
import "./devices.js";
import "./groups.js";
import "./tasks.js";
import "./actions.js";
import { enter } from "./signin.js";
import { ask, get, open } from "./link.js";
import { model, take } from "./model.js";
import { go, start, tell } from "./shell.js";

let map;

function onEvent(event, data) {
  if (event === "link" && data === model.link) return;
  take(event, data);
  // What few need is loaded when it is there.
  if (event === "yard" && data) map ??= import("./map.js").then(() => tell("yard"));
  // Panels read the model: to them a change is a state like any other.
  tell(event === "change" ? "state" : event);
  // Another node may have other parts.
  if (event === "link" && data === "live") get("node").then(({ has }) => onEvent("has", has), () => {});
}

start({ model, get, ask, go });
await enter((me) => onEvent("session", me));
open({ onEvent });
// The team is there first; what else there is to see comes after it.
await Promise.all([import("./cameras.js"), import("./views.js"), import("./audit.js"), import("./keep.js")]);
tell("state");
