// Device: the dialog with the details of one device, and the orders to it.
import { at, element, keyed, sojourn, words } from "./element.js";
import { delivery, wish } from "./desk.js";
import { back } from "./shell.js";
import { whereabouts } from "./whereabouts.js";

let devices = new Map();
let open = "";
let history = null;
let now = 0;

function show(uuid) {
  open = uuid;
  words(at("d-answer"), "");
  history = null;
  import("./history.js").then(({ History }) => { if (open === uuid) history = new History(at("d-events"), uuid); });
  fill();
  if (!at("place-device").open) at("place-device").showModal();
}

function facts(list, entries) {
  const rows = entries.map(([name, value]) => [name, value === "" ? "–" : String(value)]);
  const told = JSON.stringify(rows);
  if (list.dataset.told === told) return;
  list.dataset.told = told;
  list.replaceChildren(...rows.map(([name, value]) =>
    element("div", {}, element("dt", {}, name), element("dd", {}, value))));
}

function fill() {
  const device = devices.get(open);
  if (!device) {
    words(at("d-status"), "This device has left the network.");
    return;
  }
  words(at("d-name"), device.name);
  const task = device.objective ? `, task: ${device.objective}` : ", no task";
  words(at("d-status"), `${device.kind || "device"}, ${device.status.toLowerCase()}${task}, ${sojourn(device, now)}`);
  words(at("d-about"), device.description);
  const properties = (entries) => Object.entries(entries).map(([name, value]) => `${name} ${value}`).join(", ") || "yes";
  facts(at("d-capabilities"), Object.entries(device.capabilities).map(([name, entries]) => [name, properties(entries)]));
  facts(at("d-network"), [
    ["address", device.address], ["roles", device.roles.join(", ")], ["joined", device.joined ? `as number ${device.joined}` : ""],
    ...["laptop", "agent"].filter((name) => device[name]).map((name) => [name, device[name]]),
    ...(device.position ? [["position", whereabouts(device.position)]] : []),
    ...Object.entries(device.network), ...Object.entries(device.deployed).map(([name, label]) => [`deployed ${name}`, label]),
    ["uuid", device.uuid]]);
  const told = device.messages.map(([moment, text]) => [new Date(moment * 1000).toLocaleTimeString([], { hourCycle: "h23" }), text]);
  keyed(at("d-messages"), told.length ? told : [["", "No messages."]], (entry) => entry.join(), () => element("li"),
    (item, entry) => words(item, entry.join(" ").trim()));
  for (const button of at("place-device").querySelectorAll("form button")) button.disabled = device.gone !== null;
}

function startDevice() {
  const line = (text) => words(at("d-answer"), text);
  const dialog = at("place-device");
  at("d-close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => { if (location.hash === `#device/${open}`) back(); });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  at("d-message").addEventListener("submit", async (event) => {
    event.preventDefault();
    const body = { text: at("d-text").value };
    if (await wish("Message", `devices/${open}/message`, { body, line, done: delivery })) at("d-text").value = "";
  });
  at("d-leave").addEventListener("submit", (event) => {
    event.preventDefault();
    const seconds = Number(at("d-seconds").value);
    wish("Disconnecting", `devices/${open}/disconnect`,
      { body: { seconds }, line, done: () => `The device leaves the network and returns after ${seconds} s.` });
  });
}

export function make(dialog, { model }) {
  devices = model.devices;
  startDevice();
  return {
    update(model, event) {
      ({ devices, now } = model);
      if (open && event === "state") fill();
      if (open && event === "event") history?.update();
    },
    show,
    hide() {
      open = "";
      dialog.close();
    },
  };
}
