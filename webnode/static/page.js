// The page: every panel that there is, one stream in, and the model that all of them read.
import "./header.js";
import "./devices.js";
import "./groups.js";
import "./cameras.js";
import "./map.js";
import "./tasks.js";
import "./chaos.js";
import { ask, get, open } from "./link.js";
import { model, take } from "./model.js";
import { go, start, tell } from "./shell.js";

start({ model, get, ask, go });
open({
  onEvent(event, data) {
    if (event === "link" && data === model.link) return;
    take(event, data);
    tell(event);
  },
});
