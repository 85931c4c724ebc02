// The page: one stream in, handed to those who show it.
import { at, attribute, words } from "./element.js";
import { say } from "./desk.js";
import { stream } from "./stream.js";
import { showDevices, startDevices, tellTime } from "./devices.js";
import { showCameras, startCameras } from "./cameras.js";
import { showGroups } from "./groups.js";
import { showTasks, startTasks, readCatalogue } from "./tasks.js";
import { showYard, startMap } from "./map.js";

const LINKS = { live: "connected", lost: "connection lost, trying again", wait: "connecting" };
let link = "wait";
let statuses = new Map();

function onLink(now) {
  if (now === link) return;
  if (now === "live") readCatalogue();
  if (now === "lost") say("Connection lost. What you see is the last that was heard.");
  else if (link === "lost") say("Connected again.");
  link = now;
  attribute(at("link"), "data-link", now);
  attribute(document.body, "data-link", now);
  words(at("link"), LINKS[now]);
}

// What changed since the state before, in words for the status line.
function tellNews(state) {
  const news = [];
  for (const device of state.devices) {
    const before = statuses.get(device.uuid);
    if (before === device.status || statuses.size === 0) continue;
    if (!before) news.push(`${device.name} joined`);
    else if (device.gone !== null) news.push(`${device.name} is gone`);
    else news.push(`${device.name} is ${device.status.toLowerCase()}`);
  }
  for (const task of state.tasks) {
    const before = statuses.get(task.id);
    if (before && before !== task.status) news.push(`${task.title}: ${task.status.toLowerCase()}`);
  }
  statuses = new Map([...state.devices.map((each) => [each.uuid, each.status]), ...state.tasks.map((each) => [each.id, each.status])]);
  if (news.length) say(`${news.join(", ")}.`);
}

function onState(state) {
  if (state.node) words(at("node"), state.node);
  tellNews(state);
  showDevices(state.devices);
  showGroups(state.groups);
  showCameras(state.devices);
  showTasks(state.tasks);
}

startDevices();
startCameras();
startTasks();
startMap();
stream({ onState, onYard: showYard, onBeat: ({ now }) => tellTime(now), onLink });
