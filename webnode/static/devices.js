// Devices: the list in the order of joining.
import { at, attribute, badge, element, keyed, sojourn, state, words } from "./element.js";
import { delivery, say, wish } from "./desk.js";
import { panel } from "./panel.js";
import { go } from "./shell.js";

let devices = [];
let now = 0;

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
    if (device) words(child.querySelector(".age"), sojourn(device, now));
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
  words(item.querySelector(".age"), sojourn(device, now));
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

panel({ place: "device", title: "Device", load: () => import("./device.js") });
