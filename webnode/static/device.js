// Device: the dialog with the details of one device, and the orders to it.
import { byId, createElement, updateList, formatPresence, setText } from "./element.js";
import { describeDelivery, sendRequest } from "./request.js";
import { back } from "./shell.js";
import { formatPosition } from "./format-position.js";

let devices = new Map();
let open = "";
let history = null;
let now = 0;

function openDevice(uuid) {
  open = uuid;
  setText(byId("d-result"), "");
  history = null;
  import("./history.js").then(({ History }) => { if (open === uuid) history = new History(byId("d-events"), uuid); });
  showDetails();
  if (!byId("place-device").open) byId("place-device").showModal();
}

function listProperties(list, entries) {
  const rows = entries.map(([name, value]) => [name, value === "" ? "–" : String(value)]);
  const told = JSON.stringify(rows);
  if (list.dataset.told === told) return;
  list.dataset.told = told;
  list.replaceChildren(...rows.map(([name, value]) =>
    createElement("div", {}, createElement("dt", {}, name), createElement("dd", {}, value))));
}

function showDetails() {
  const device = devices.get(open);
  if (!device) {
    setText(byId("d-status"), "This device has left the network.");
    return;
  }
  setText(byId("d-name"), device.name);
  const task = device.objective ? `, task: ${device.objective}` : ", no task";
  setText(byId("d-status"), `${device.kind || "device"}, ${device.status.toLowerCase()}${task}, ${formatPresence(device, now)}`);
  setText(byId("d-about"), device.description);
  const properties = (entries) => Object.entries(entries).map(([name, value]) => `${name} ${value}`).join(", ") || "yes";
  listProperties(byId("d-capabilities"), Object.entries(device.capabilities).map(([name, entries]) => [name, properties(entries)]));
  listProperties(byId("d-network"), [
    ["address", device.address], ["roles", device.roles.join(", ")], ["joined", device.joined ? `as number ${device.joined}` : ""],
    ...["laptop", "agent"].filter((name) => device[name]).map((name) => [name, device[name]]),
    ...(device.position ? [["position", formatPosition(device.position)]] : []),
    ...Object.entries(device.network), ...Object.entries(device.deployed).map(([name, label]) => [`deployed ${name}`, label]),
    ["uuid", device.uuid]]);
  const told = device.messages.map(([moment, text]) => [new Date(moment * 1000).toLocaleTimeString([], { hourCycle: "h23" }), text]);
  updateList(byId("d-messages"), told.length ? told : [["", "No messages."]], (entry) => entry.join(), () => createElement("li"),
    (item, entry) => setText(item, entry.join(" ").trim()));
  for (const button of byId("place-device").querySelectorAll("form button")) button.disabled = device.gone !== null;
}

function startDevice() {
  const line = (text) => setText(byId("d-result"), text);
  const dialog = byId("place-device");
  byId("d-close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => { if (location.hash === `#device/${open}`) back(); });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  byId("d-message").addEventListener("submit", async (event) => {
    event.preventDefault();
    const body = { text: byId("d-text").value };
    if (await sendRequest("Message", `devices/${open}/message`, { body, line, done: describeDelivery })) byId("d-text").value = "";
  });
  byId("d-leave").addEventListener("submit", (event) => {
    event.preventDefault();
    const seconds = Number(byId("d-seconds").value);
    sendRequest("Disconnecting", `devices/${open}/disconnect`,
      { body: { seconds }, line, done: () => `The device leaves the network and returns after ${seconds} s.` });
  });
}

export function make(dialog, { model }) {
  devices = model.devices;
  startDevice();
  return {
    update(model, event) {
      ({ devices, now } = model);
      if (open && event === "state") showDetails();
      if (open && event === "event") history?.update();
    },
    show: openDevice,
    hide() {
      open = "";
      dialog.close();
    },
  };
}
