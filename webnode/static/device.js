// Device: the dialog with the details of one device, and the requests to it.
import { byId, createElement, describeStatus, updateList, formatPresence, setText } from "./element.js";
import { describeDelivery, sendRequest } from "./request.js";
import { back } from "./shell.js";
import { formatPosition } from "./format-position.js";
import { formatNumber, formatTime, text, textOf } from "./texts.js";

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
    setText(byId("d-status"), text("device.left"));
    return;
  }
  setText(byId("d-name"), device.name);
  setText(byId("d-status"), text(device.objective ? "device.summary" : "device.summary_no_task", {
    kind: device.kind || text("device.kind_unknown"), status: describeStatus(device.status), task: device.objective, time: formatPresence(device, now),
  }));
  setText(byId("d-about"), device.description);
  const properties = (entries) => Object.entries(entries).map(([name, value]) => `${name} ${value}`).join(", ") || text("device.has");
  listProperties(byId("d-capabilities"), Object.entries(device.capabilities).map(([name, entries]) => [name, properties(entries)]));
  listProperties(byId("d-network"), [
    [text("device.address"), device.address], [text("device.roles"), device.roles.join(", ")],
    [text("device.joined"), device.joined ? text("device.joined_as", { number: device.joined }) : ""],
    ...(device.laptop ? [[text("device.laptop"), device.laptop]] : []), ...(device.agent ? [[text("device.agent"), device.agent]] : []),
    ...(device.position ? [[text("device.position"), formatPosition(device.position)]] : []),
    ...Object.entries(device.network).map(([name, value]) => [textOf("device.network", name), formatNumber(value)]),
    ...Object.entries(device.deployed).map(([name, label]) => [text("device.deployed", { name }), label]),
    ["uuid", device.uuid]]);
  const told = device.messages.map(([moment, message]) => [formatTime(moment), message]);
  updateList(byId("d-messages"), told.length ? told : [["", text("message.none")]], (entry) => entry.join(), () => createElement("li"),
    (item, entry) => setText(item, entry.join(" ").trim()));
  for (const button of byId("place-device").querySelectorAll("form button")) button.disabled = device.gone !== null;
}

function startDevice() {
  const line = (message) => setText(byId("d-result"), message);
  const dialog = byId("place-device");
  byId("d-close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => { if (location.hash === `#device/${open}`) back(); });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  byId("d-message").addEventListener("submit", async (event) => {
    event.preventDefault();
    const body = { text: byId("d-text").value };
    if (await sendRequest(text("message.action"), `devices/${open}/message`, { body, line, done: describeDelivery })) byId("d-text").value = "";
  });
  byId("d-leave").addEventListener("submit", (event) => {
    event.preventDefault();
    const seconds = Number(byId("d-seconds").value);
    sendRequest(text("device.disconnecting"), `devices/${open}/disconnect`,
      { body: { seconds }, line, done: () => text("device.disconnected", { seconds }) });
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
