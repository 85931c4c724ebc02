// Devices: the list in the order of joining, and the dialog with what is known of one.
import { at, attribute, badge, element, keyed, span, state, words } from "./element.js";
import { delivery, say, wish } from "./desk.js";
import { panel } from "./panel.js";
import { back, go } from "./shell.js";

let devices = [];
let open = "";
let history = null;
let now = 0;

const age = (device) => (device.gone === null ? `here ${span(now - device.since)}` : `gone ${span(now - device.gone)}`);

function showDevices(list) {
  devices = list;
  const here = list.filter((device) => device.gone === null).length;
  words(at("count"), list.length ? String(here) : "");
  at("no-devices").hidden = list.length > 0;
  keyed(at("devices"), list, (device) => device.uuid, row, update);
}

function tellTime(moment) {
  now = moment;
  for (const child of at("devices").children) {
    const device = devices.find((each) => each.uuid === child.dataset.key);
    if (device) words(child.querySelector(".age"), age(device));
  }
}

function row(device) {
  const button = element(
    "button", { class: "device", "aria-haspopup": "dialog" },
    element("b"), badge(), element("span", { class: "kind" }), element("span", { class: "age" }), element("span", { class: "objective" }));
  let pointer = "mouse";
  button.addEventListener("pointerdown", (event) => { pointer = event.pointerType; });
  // A tap or Enter opens at once; with a mouse one click only marks, as the double click is what opens.
  button.addEventListener("click", (event) => { if (event.detail === 0 || pointer !== "mouse") go(`device/${device.uuid}`); });
  button.addEventListener("dblclick", () => go(`device/${device.uuid}`));
  return element("li", {}, button);
}

function update(item, device) {
  attribute(item.firstChild, "data-state", device.status);
  words(item.querySelector("b"), device.name);
  words(item.querySelector(".kind"), device.kind);
  state(item.querySelector(".badge"), device.status);
  words(item.querySelector(".objective"), device.objective || "no task");
  words(item.querySelector(".age"), age(device));
}

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
  const device = devices.find((each) => each.uuid === open);
  if (!device) {
    words(at("d-status"), "This device has left the network and is no longer remembered.");
    return;
  }
  words(at("d-name"), device.name);
  const task = device.objective ? `, task: ${device.objective}` : ", no task";
  words(at("d-status"), `${device.kind || "device"}, ${device.status.toLowerCase()}${task}, ${age(device)}`);
  words(at("d-about"), device.description);
  const properties = (entries) => Object.entries(entries).map(([name, value]) => `${name} ${value}`).join(", ") || "yes";
  facts(at("d-capabilities"), Object.entries(device.capabilities).map(([name, entries]) => [name, properties(entries)]));
  facts(at("d-network"), [
    ["address", device.address], ["roles", device.roles.join(", ")], ["joined", device.joined ? `as number ${device.joined}` : ""],
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
  dialog.addEventListener("close", () => { if (open) back(); });
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
      { body: { seconds }, line, done: () => `It leaves the network and comes back after ${seconds} s.` });
  });
}

function startDevices() {
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

panel({
  place: "device",
  title: "Device",
  make(dialog) {
    startDevice();
    return {
      update(model, event) {
        if (open && event === "state") fill();
        if (open && event === "event") history?.update();
      },
      show,
      hide() {
        open = "";
        dialog.close();
      },
    };
  },
});
