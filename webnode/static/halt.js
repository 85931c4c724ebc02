// Stop: one button at the same place in every view, also before an open dialog, and a line that lets the team go on.
import { attribute, element, words } from "./element.js";
import { wish } from "./desk.js";
import { panel } from "./panel.js";

const STANDS = "stands";
const GOES_ON = "goes on";
const NO_ROBOT = "has no robot";
const MOST = 8;

const robots = (count) => `${count} ${count === 1 ? "robot stands" : "robots stand"}`;
const some = (lines) => (lines.length > MOST ? [...lines.slice(0, MOST), ` And so on: ${lines.length} in all.`] : lines).join("");

// What came of it: how many stand, and by name each device that says something else than was wanted.
function outcome(devices, told, wanted) {
  const name = (uuid) => devices.get(uuid)?.name ?? uuid.slice(0, 8);
  const strange = Object.entries(told).filter(([, said]) => ![wanted, NO_ROBOT].includes(said)).map(([uuid, said]) => ` ${name(uuid)} ${said}.`);
  const count = Object.values(told).filter((said) => said === STANDS).length;
  if (wanted === GOES_ON) return `${count ? "Not every robot goes on." : "The team goes on."}${some(strange)}`;
  return `${strange.length ? "Stopping" : "Stopped"}: ${robots(count)}.${some(strange)}`;
}

// What the line says: "stopped" only where every robot says that it stands.
function standing({ halted, halt }) {
  const by = [...new Set((halt?.stops ?? []).map((stop) => stop.by).filter(Boolean))].join(", ");
  if (halted) return ["The team is stopped.", `${by ? ` By ${by}.` : ""} Whoever had a task keeps it. `];
  const { standing: still = [], others = [] } = halt ?? {};
  if (!halt?.ordered) return ["Not every robot goes on.", ` ${some(still.map((name) => ` ${name} stands.`)).trim()} `];
  const rest = some(others.map(({ name, says }) => ` ${name} ${says}.`));
  return ["Stopping.", ` ${still.length} of ${still.length + others.length} robots stand.${rest} `];
}

// Behind an open dialog nothing can be pressed: the button goes where it can.
function before(dialog, button, root) {
  const home = dialog ?? root;
  if (button.parentNode !== home) home.prepend(button);
}

export function make(root, { model }) {
  const stop = element("button", { class: "stop", title: "All robots stand at once" }, "Stop");
  const go = element("button", {}, "Let it go on");
  const title = element("b", {});
  const rest = element("span", {});
  const banner = element("p", { class: "halted" }, title, rest, go);
  banner.hidden = true;
  root.classList.add("halt");
  root.append(stop, banner);
  const done = (wanted) => ({ devices }) => outcome(model.devices, devices, wanted);
  stop.addEventListener("click", () => wish("Stopping", "halt", { done: done(STANDS) }));
  // A release ends the stops that are shown, and none that came meanwhile.
  go.addEventListener("click", () => {
    const body = model.halt ? { stops: model.halt.stops.map(({ id }) => id) } : undefined;
    wish("Letting it go on", "halt", { method: "DELETE", body, done: done(GOES_ON) });
  });
  const watch = new MutationObserver(() => before(document.querySelector("dialog[open]"), stop, root));
  watch.observe(document.body, { subtree: true, attributeFilter: ["open"] });
  return {
    update() {
      banner.hidden = !(model.halted || model.halt?.stops.length);
      const [first, more] = standing(model);
      words(title, first);
      words(rest, more);
      attribute(document.body, "data-halted", model.halted);
    },
    close() {
      watch.disconnect();
      stop.remove();
    },
  };
}

panel({ place: "header", order: 1, title: "Stop", needs: { role: "operator" }, make });
