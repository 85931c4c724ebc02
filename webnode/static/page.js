// The page: registers all panels, and feeds one event stream into the model that they read.
import "./theme.js";
import "./header.js";
import "./stop.js";
import "./devices.js";
import "./groups.js";
import "./tasks.js";
import "./operator-panels.js";
import { signInVisitor } from "./signin.js";
import { get, openStream, send } from "./connection.js";
import { applyEvent, model } from "./model.js";
import { go, notifyPanels, startPanels } from "./shell.js";

// Panels that few pages need are loaded when their data arrives.
const hasDevice = (what) => [...model.devices.values()].some(what);
const LATER = [
  { on: "yard", is: () => model.yard, load: () => import("./map.js") },
  { on: "state", is: () => hasDevice(({ capabilities }) => capabilities.camera), load: () => import("./cameras.js") },
  { on: "state", is: () => hasDevice(({ position }) => position), load: () => import("./positions.js") },
];

function onEvent(event, data) {
  if (event === "link" && data === model.link) return;
  applyEvent(event, data);
  // Panels read the model, so a change is the same as a state to them.
  const kind = event === "change" ? "state" : event;
  for (const later of LATER) if (later.on === kind && later.is()) later.loaded ??= later.load().then(() => notifyPanels(kind), () => { later.loaded = null; });
  notifyPanels(kind);
  // Another node may have other services.
  if (event === "link" && data === "live") get("node").then(({ has }) => onEvent("has", has), () => {});
}

startPanels({ model, get, send, go });
await signInVisitor((me) => onEvent("session", me));
openStream({ onEvent });
// The team is shown first; further panels load afterwards.
import("./views.js");
import("./fault-panels.js");
import("./cache.js");
