// The page: every panel that there is, one stream in, and the model that all of them read.
import "./header.js";
import "./halt.js";
import "./devices.js";
import "./groups.js";
import "./cameras.js";
import "./map.js";
import "./tasks.js";
import "./actions.js";
import { enter } from "./signin.js";
import { ask, get, open } from "./link.js";
import { model, take } from "./model.js";
import { go, start, tell } from "./shell.js";

function onEvent(event, data) {
  if (event === "link" && data === model.link) return;
  take(event, data);
  tell(event);
}

start({ model, get, ask, go });
await enter((me) => onEvent("session", me));
open({ onEvent });
