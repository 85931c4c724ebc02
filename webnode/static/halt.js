// Stop: one button at the same place in every view, also before an open dialog, and a line that lets the team go on.
import { attribute, element } from "./element.js";
import { wish } from "./desk.js";
import { panel } from "./panel.js";

const STANDS = "stands";
const MOST = 8;
const IDLE = ["has no robot", "goes on", STANDS];

// What came of it: how many stand, and by name whoever says something else.
function outcome(devices, { halted, devices: told }) {
  const name = (uuid) => devices.get(uuid)?.name ?? uuid.slice(0, 8);
  const strange = Object.entries(told).filter(([, said]) => !IDLE.includes(said)).map(([uuid, said]) => ` ${name(uuid)} ${said}.`);
  const odd = strange.length > MOST ? [...strange.slice(0, MOST), ` And so on: ${strange.length} in all.`] : strange;
  const count = Object.values(told).filter((said) => said === STANDS).length;
  return `${halted ? `Stopped: ${count} ${count === 1 ? "robot stands" : "robots stand"}.` : "The team goes on."}${odd.join("")}`;
}

// Behind an open dialog nothing can be pressed: the button goes where it can.
function before(dialog, button, root) {
  const home = dialog ?? root;
  if (button.parentNode !== home) home.prepend(button);
}

export function make(root, { model }) {
  const stop = element("button", { class: "stop", title: "All robots stand at once" }, "Stop");
  const go = element("button", {}, "Let it go on");
  const banner = element("p", { class: "halted" }, element("b", {}, "The team is stopped."), " Whoever had a task keeps it. ", go);
  banner.hidden = true;
  root.classList.add("halt");
  root.append(stop, banner);
  const done = (told) => outcome(model.devices, told);
  stop.addEventListener("click", () => wish("Stopping", "halt", { done }));
  go.addEventListener("click", () => wish("Letting it go on", "halt", { method: "DELETE", done }));
  const watch = new MutationObserver(() => before(document.querySelector("dialog[open]"), stop, root));
  watch.observe(document.body, { subtree: true, attributeFilter: ["open"] });
  return {
    update() {
      banner.hidden = !model.halted;
      attribute(document.body, "data-halted", model.halted);
    },
    close() {
      watch.disconnect();
      stop.remove();
    },
  };
}

panel({ place: "header", order: 1, title: "Stop", needs: { role: "operator" }, make });
