// The page: registers all panels, and feeds one event stream into the model that they read.
import "./theme.js";
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

// Panels that few pages need are loaded when their data arrives.
const some = (what) => [...model.devices.values()].some(what);
const LATER = [
  { on: "yard", is: () => model.yard, load: () => import("./map.js") },
  { on: "state", is: () => some(({ capabilities }) => capabilities.camera), load: () => import("./cameras.js") },
  { on: "state", is: () => some(({ position }) => position), load: () => import("./positions.js") },
];

function onEvent(event, data) {
  if (event === "link" && data === model.link) return;
  take(event, data);
  // Panels read the model, so a change is the same as a state to them.
  const told = event === "change" ? "state" : event;
  for (const later of LATER) if (later.on === told && later.is()) later.loaded ??= later.load().then(() => tell(told), () => { later.loaded = null; });
  tell(told);
  // Another node may have other services.
  if (event === "link" && data === "live") get("node").then(({ has }) => onEvent("has", has), () => {});
}

start({ model, get, ask, go });
await enter((me) => onEvent("session", me));
open({ onEvent });
// The team is shown first; further panels load afterwards.
import("./views.js");
import("./fault-panels.js");
import("./keep.js");
