// Devices: the list in the order of joining, with a filter if it is long.
import { byId, setAttribute, createBadge, createElement, describeStatus, updateList, formatPresence, setBadge, setText } from "./element.js";
import { describeDelivery, showStatus, sendRequest } from "./request.js";
import { registerPanel } from "./panel.js";
import { go } from "./shell.js";
import { formatNumber, text } from "./texts.js";

const FEW = 20;
const MANY = 100;
const items = new Map();
let devices = [];
let now = 0;
let updatedAt = 0;

const searchableText = ({ name, kind, status, objective, capabilities }) =>
  [name, kind, status, describeStatus(status), objective, ...Object.keys(capabilities)].join(" ").toLowerCase();

function showDevices(list) {
  devices = list;
  byId("filter").hidden = list.length <= FEW;
  byId("place-devices").classList.toggle("many", list.length > MANY);
  byId("no-devices").hidden = list.length > 0;
  if (items.size > list.length) {
    const known = new Set(list.map(({ uuid }) => uuid));
    for (const uuid of items.keys()) if (!known.has(uuid)) items.delete(uuid);
  }
  showMatching();
}

// Show the devices that contain each word of the filter.
function showMatching() {
  const asked = byId("filter").hidden ? [] : byId("filter").value.toLowerCase().split(" ").filter(Boolean);
  const found = asked.length ? devices.filter((device) => asked.every((word) => searchableText(device).includes(word))) : devices;
  const here = devices.filter((device) => device.gone === null).length;
  setText(byId("count"), !devices.length ? "" : asked.length ? text("devices.found", { count: found.length, total: devices.length }) : formatNumber(here));
  byId("not-found").hidden = !asked.length || found.length > 0;
  updateList(byId("devices"), found, (device) => device.uuid, createRow, updateRow);
}

// Ages are shown in seconds, so they are updated once a second.
function updateAges(moment) {
  now = moment;
  if (Math.abs(now - updatedAt) < 1) return;
  updatedAt = now;
  for (const { age, device } of items.values()) setText(age, formatPresence(device, now));
}

function createRow(device) {
  const age = createElement("span", { class: "age" });
  const button = createElement(
    "button", { class: "device", "aria-haspopup": "dialog" },
    createElement("b"), createBadge(), createElement("span", { class: "kind" }), age, createElement("span", { class: "objective" }));
  let pointer = "mouse";
  button.addEventListener("pointerdown", (event) => { pointer = event.pointerType; });
  // A tap or Enter opens the device; with a mouse a double click does.
  button.addEventListener("click", (event) => { if (event.detail === 0 || pointer !== "mouse") go(`device/${device.uuid}`); });
  button.addEventListener("dblclick", () => go(`device/${device.uuid}`));
  const item = createElement("li", {}, button);
  items.set(device.uuid, { age, device: null });
  return item;
}

// Skip the row of a device that has not changed: of a thousand devices few change at a time.
function updateRow(item, device) {
  const shown = items.get(device.uuid);
  if (shown.device === device) return;
  shown.device = device;
  setAttribute(item.firstChild, "data-state", device.status);
  setText(item.querySelector("b"), device.name);
  setText(item.querySelector(".kind"), device.kind);
  setBadge(item.querySelector(".badge"), device.status);
  setText(item.querySelector(".objective"), device.objective || text("device.no_task"));
  setText(shown.age, formatPresence(device, now));
}

function startDevices() {
  byId("filter").addEventListener("input", showMatching);
  byId("announce").addEventListener("submit", async (event) => {
    event.preventDefault();
    const body = { text: byId("announce-text").value };
    if (await sendRequest(text("message.action"), "message", { body, line: showStatus, done: describeDelivery })) byId("announce-text").value = "";
  });
}

registerPanel({
  place: "devices",
  make() {
    startDevices();
    return {
      update(model, event) {
        if (event === "state") showDevices([...model.devices.values()]);
        if (event === "beat") updateAges(model.now);
      },
    };
  },
});

registerPanel({ place: "device", load: () => import("./device.js") });
