// Devices: the list in the order of joining, with a filter if it is long.
import { at, attribute, badge, element, keyed, sojourn, state, words } from "./element.js";
import { delivery, say, wish } from "./desk.js";
import { panel } from "./panel.js";
import { go } from "./shell.js";

const FEW = 20;
const MANY = 100;
const items = new Map();
let devices = [];
let now = 0;
let told = 0;

const described = ({ name, kind, status, objective, capabilities }) =>
  [name, kind, status, objective, ...Object.keys(capabilities)].join(" ").toLowerCase();

function showDevices(list) {
  devices = list;
  at("filter").hidden = list.length <= FEW;
  at("place-devices").classList.toggle("many", list.length > MANY);
  at("no-devices").hidden = list.length > 0;
  if (items.size > list.length) {
    const known = new Set(list.map(({ uuid }) => uuid));
    for (const uuid of items.keys()) if (!known.has(uuid)) items.delete(uuid);
  }
  showFound();
}

// Show the devices that contain each word of the filter.
function showFound() {
  const asked = at("filter").hidden ? [] : at("filter").value.toLowerCase().split(" ").filter(Boolean);
  const found = asked.length ? devices.filter((device) => asked.every((word) => described(device).includes(word))) : devices;
  const here = devices.filter((device) => device.gone === null).length;
  words(at("count"), !devices.length ? "" : asked.length ? `${found.length} of ${devices.length}` : String(here));
  at("not-found").hidden = !asked.length || found.length > 0;
  keyed(at("devices"), found, (device) => device.uuid, row, update);
}

// Ages are shown in seconds, so they are updated once a second.
function tellTime(moment) {
  now = moment;
  if (Math.abs(now - told) < 1) return;
  told = now;
  for (const { age, device } of items.values()) words(age, sojourn(device, now));
}

function row(device) {
  const age = element("span", { class: "age" });
  const button = element(
    "button", { class: "device", "aria-haspopup": "dialog" },
    element("b"), badge(), element("span", { class: "kind" }), age, element("span", { class: "objective" }));
  let pointer = "mouse";
  button.addEventListener("pointerdown", (event) => { pointer = event.pointerType; });
  // A tap or Enter opens the device; with a mouse a double click does.
  button.addEventListener("click", (event) => { if (event.detail === 0 || pointer !== "mouse") go(`device/${device.uuid}`); });
  button.addEventListener("dblclick", () => go(`device/${device.uuid}`));
  const item = element("li", {}, button);
  items.set(device.uuid, { age, device: null });
  return item;
}

// Skip the row of a device that has not changed: of a thousand devices few change at a time.
function update(item, device) {
  const shown = items.get(device.uuid);
  if (shown.device === device) return;
  shown.device = device;
  attribute(item.firstChild, "data-state", device.status);
  words(item.querySelector("b"), device.name);
  words(item.querySelector(".kind"), device.kind);
  state(item.querySelector(".badge"), device.status);
  words(item.querySelector(".objective"), device.objective || "no task");
  words(shown.age, sojourn(device, now));
}

function startDevices() {
  at("filter").addEventListener("input", showFound);
  at("announce").addEventListener("submit", async (event) => {
    event.preventDefault();
    const body = { text: at("announce-text").value };
    if (await wish("Message", "message", { body, line: say, done: delivery })) at("announce-text").value = "";
  });
}

panel({
  place: "devices",
  title: "Devices",
  make() {
    startDevices();
    return {
      update(model, event) {
        if (event === "state") showDevices([...model.devices.values()]);
        if (event === "beat") tellTime(model.now);
      },
    };
  },
});

panel({ place: "device", title: "Device", load: () => import("./device.js") });
