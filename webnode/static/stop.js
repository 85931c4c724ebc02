// Stop: one button at the same place in every view, also in front of an open dialog, and a line that releases the team.
import { setAttribute, createElement, setText } from "./element.js";
import { sendRequest } from "./request.js";
import { registerPanel } from "./panel.js";
import { text, textOf } from "./texts.js";

const STANDS = "stands";
const GOES_ON = "goes on";
const MOST = 8;

const listFirst = (said) => said.slice(0, MOST).map((line) => ` ${line}.`).join("") + (said.length > MOST ? ` ${text("stop.more", { count: said.length })}` : "");
const CODES = { [STANDS]: "stands", [GOES_ON]: "goes_on" };
const describeRobot = (name, said) => `${name} ${textOf("stop.robot", CODES[said] ?? said, said)}`;

// The result of a stop or release: the number of robots that stand, and by name each device that is not in the
// requested state.
function describeOutcome(devices, told, wanted) {
  const robots = Object.entries(told).filter(([, said]) => said !== "has no robot");
  const odd = robots.filter(([, said]) => said !== wanted).map(([uuid, said]) => describeRobot(devices.get(uuid)?.name ?? uuid.slice(0, 8), said));
  const count = robots.length - odd.length;
  if (wanted === GOES_ON) return text(odd.length ? "stop.not_released" : "stop.released") + listFirst(odd);
  return text(odd.length ? "stop.some_stand" : "stop.all_stand", { count }) + listFirst(odd);
}

// The text of the line: "stopped" only if every robot confirms that it stands.
function describeState({ halted, halt }) {
  if (halted) return [text("stop.stopped"), ` ${text("stop.tasks_stay")} `];
  const { ordered, standing = [], others = [] } = halt ?? {};
  if (!ordered) return [text("stop.not_released"), listFirst(standing.map((name) => describeRobot(name, STANDS)))];
  return [text("stop.stopping"), ` ${text("stop.standing", { count: standing.length, total: standing.length + others.length })}${listFirst(others.map(({ name, says }) => describeRobot(name, says)))}`];
}

// Elements behind a modal dialog cannot be clicked, so the button moves into the dialog.
function moveButton(dialog, button, root) {
  const home = dialog ?? root;
  if (button.parentNode !== home) home.prepend(button);
}

export function make(root, { model }) {
  const stop = createElement("button", { class: "stop", title: text("stop.label") }, text("stop.button"));
  const go = createElement("button", {}, text("stop.release"));
  const parts = [createElement("b", {}), createElement("span", {})];
  const banner = createElement("p", { class: "halted" }, ...parts, go);
  banner.hidden = true;
  root.classList.add("halt");
  root.append(stop, banner);
  const done = (wanted) => ({ devices }) => describeOutcome(model.devices, devices, wanted);
  stop.addEventListener("click", () => sendRequest(text("stop.stopping_action"), "halt", { done: done(STANDS) }));
  // A release ends the stops that the page shows, not stops that were requested since.
  go.addEventListener("click", () => {
    const body = model.halt ? { stops: model.halt.stops.map(({ id }) => id) } : undefined;
    sendRequest(text("stop.releasing_action"), "halt", { method: "DELETE", body, done: done(GOES_ON) });
  });
  const watch = new MutationObserver(() => moveButton(document.querySelector("dialog[open]"), stop, root));
  watch.observe(document.body, { subtree: true, attributeFilter: ["open"] });
  return {
    update() {
      banner.hidden = !(model.halted || model.halt?.stops.length);
      describeState(model).forEach((said, n) => setText(parts[n], said));
      setAttribute(document.body, "data-halted", model.halted);
    },
    close() {
      watch.disconnect();
      stop.remove();
    },
  };
}

registerPanel({ place: "header", order: 1, needs: { role: "operator" }, make });
