// Stop: one button at the same place in every view, also in front of an open dialog, and a line that releases the team.
import { attribute, element, words } from "./element.js";
import { wish } from "./desk.js";
import { panel } from "./panel.js";

const STANDS = "stands";
const GOES_ON = "goes on";
const MOST = 8;

const some = (said) => said.slice(0, MOST).map((line) => ` ${line}.`).join("") + (said.length > MOST ? ` And more: ${said.length} in total.` : "");

// The result of an order: the number of robots that stand, and each device in another state than requested, by name.
function outcome(devices, told, wanted) {
  const robots = Object.entries(told).filter(([, said]) => said !== "has no robot");
  const odd = robots.filter(([, said]) => said !== wanted).map(([uuid, said]) => `${devices.get(uuid)?.name ?? uuid.slice(0, 8)} ${said}`);
  const count = robots.length - odd.length;
  if (wanted === GOES_ON) return `${odd.length ? "Not every robot is released" : "The team is released"}.${some(odd)}`;
  return `${odd.length ? "Stopping" : "Stopped"}: ${count} ${count === 1 ? "robot stands" : "robots stand"}.${some(odd)}`;
}

// The text of the line: "stopped" only if every robot confirms that it stands.
function state({ halted, halt }) {
  if (halted) return ["The team is stopped.", " Tasks stay assigned. "];
  const { ordered, standing = [], others = [] } = halt ?? {};
  if (!ordered) return ["Not every robot is released.", some(standing.map((name) => `${name} stands`))];
  return ["Stopping.", ` ${standing.length} of ${standing.length + others.length} robots stand.${some(others.map(({ name, says }) => `${name} ${says}`))}`];
}

// Elements behind a modal dialog cannot be clicked, so the button moves into the dialog.
function before(dialog, button, root) {
  const home = dialog ?? root;
  if (button.parentNode !== home) home.prepend(button);
}

export function make(root, { model }) {
  const stop = element("button", { class: "stop", title: "Stop all robots" }, "Stop");
  const go = element("button", {}, "Release");
  const parts = [element("b", {}), element("span", {})];
  const banner = element("p", { class: "halted" }, ...parts, go);
  banner.hidden = true;
  root.classList.add("halt");
  root.append(stop, banner);
  const done = (wanted) => ({ devices }) => outcome(model.devices, devices, wanted);
  stop.addEventListener("click", () => wish("Stopping", "halt", { done: done(STANDS) }));
  // A release ends the stops that are shown, not those ordered meanwhile.
  go.addEventListener("click", () => {
    const body = model.halt ? { stops: model.halt.stops.map(({ id }) => id) } : undefined;
    wish("Releasing", "halt", { method: "DELETE", body, done: done(GOES_ON) });
  });
  const watch = new MutationObserver(() => before(document.querySelector("dialog[open]"), stop, root));
  watch.observe(document.body, { subtree: true, attributeFilter: ["open"] });
  return {
    update() {
      banner.hidden = !(model.halted || model.halt?.stops.length);
      state(model).forEach((said, n) => words(parts[n], said));
      attribute(document.body, "data-halted", model.halted);
    },
    close() {
      watch.disconnect();
      stop.remove();
    },
  };
}

panel({ place: "header", order: 1, title: "Stop", needs: { role: "operator" }, make });
