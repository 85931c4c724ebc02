// Tasks: assign a predefined one, show the state of each, and cancel, pause or resume it.
import { alike, at, attribute, badge, element, keyed, several, state, words } from "./element.js";
import { say, wish } from "./desk.js";
import { ask, get } from "./link.js";
import { panel } from "./panel.js";

const ENDED = ["COMPLETED", "FAILED", "CANCELLED"];
const SHOWN = 8;
const histories = new Map();

function showTasks(tasks) {
  at("no-tasks").hidden = tasks.length > 0;
  keyed(at("tasks"), tasks.slice(0, SHOWN), (task) => task.id, row, (item, task) => {
    words(item.querySelector("b"), task.title);
    state(item.querySelector(".badge"), task.status);
    const result = task.result ? `Done by ${task.result.by} in ${task.result.took.toFixed(1)} s. ` : "";
    words(item.querySelector(".note"), (task.group && `Group ${task.group}. `) + result + task.note);
    why(item.querySelector(".why"), task.why);
    const [button, rest] = item.querySelectorAll("button");
    button.hidden = rest.hidden = ENDED.includes(task.status);
    button.setAttribute("aria-label", `Cancel ${task.title}`);
    words(rest, task.paused ? "Resume" : "Pause");
    rest.setAttribute("aria-label", `${rest.textContent} ${task.title}`);
  });
}

function row(task) {
  const button = element("button", {}, "Cancel");
  button.addEventListener("click", () => wish(`Cancelling ${task.title}`, `tasks/${encodeURIComponent(task.id)}/cancel`));
  const rest = element("button", {}, "Pause");
  rest.addEventListener("click", () => {
    const isPaused = rest.textContent === "Resume";
    wish(`${isPaused ? "Resuming" : "Pausing"} ${task.title}`, `tasks/${encodeURIComponent(task.id)}/${isPaused ? "resume" : "pause"}`);
  });
  return element("li", {}, element("b"), badge(), element("span", { class: "note" }),
    element("details", { class: "why" }, element("summary"), element("div")), history(task), button, rest);
}

// The history of a task, loaded when it is opened.
function history(task) {
  const list = element("ol", { class: "story", tabindex: 0, "aria-label": `History of ${task.title}, the newest first` });
  const box = element("details", { class: "history" }, element("summary", {}, "History"), list);
  box.addEventListener("toggle", async () => {
    const { History } = await import("./history.js");
    if (box.open) histories.set(task.id, new History(list, task.id));
    else histories.delete(task.id);
  });
  return box;
}

// The decisions on a task: the newest in one line; opened, each with its rule and the reports.
function why(box, epochs) {
  box.hidden = !epochs.length;
  const told = JSON.stringify(epochs);
  if (box.hidden || box.dataset.told === told) return;
  box.dataset.told = told;
  words(box.firstChild, `${epochs[0].chosen} – ${epochs[0].agree} of ${epochs[0].of} agree${epochs[0].differ.map((name) => `, ${name} differs`).join("")}`);
  attribute(box, "data-agree", epochs[0].agree === epochs[0].of && !epochs[0].differ.length);
  box.lastChild.replaceChildren(...epochs.flatMap((each) => [
    element("p", {}, element("b", {}, `${each.epoch}. ${each.chosen}`), ` by ${each.rule}: ${each.hysteresis}${each.agreed && `; agreed on ${each.agreed}`}`),
    element("table", {}, ...each.rows.map((row) => element("tr", {}, element("th", { scope: "row" }, row.name),
      element("td", {}, row.cost?.toFixed(2) ?? "no report"), element("td", {}, row.note)))),
    ...(each.reported > each.rows.length ? [`of ${each.reported} reports`] : [])]));
}

function outcome({ able = [], refused = {} }) {
  const no = alike(refused).map(([names, why]) => `Not possible for ${several(names)}: ${why}`);
  const yes = able.length ? [`Assigned to ${several(able)}`] : no.length ? ["No device can take it"] : ["Assigned"];
  return `${[...yes, ...no].join(". ")}.`;
}

// The catalogue is read when the page connects or reconnects.
async function readCatalogue() {
  const catalogue = await get("catalogue").catch(() => null);
  if (!catalogue) return;
  const chosen = at("task").value;
  at("task").replaceChildren(...catalogue.map((task) => element("option", { value: task.name }, task.title || task.name)));
  if (chosen) at("task").value = chosen;
}

function startTasks() {
  at("assign").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!at("task").value) return say("There is no predefined task to assign.");
    const group = at("group").value.trim();
    wish("Assigning", "tasks", { body: { name: at("task").value, ...(group && { group }) }, done: outcome });
  });
  at("demo").addEventListener("click", async () => {
    at("demo").disabled = true;
    say("Starting the demo …");
    try {
      await ask("POST", "demo");
      say("The demo runs.");
    } catch (error) {
      say(error.message);
    }
    at("demo").disabled = false;
  });
}

panel({
  place: "tasks",
  title: "Tasks",
  make() {
    startTasks();
    return {
      update(model, event) {
        if (event === "state") showTasks([...model.tasks.values()]);
        if (event === "event") histories.forEach((each) => each.update());
        if (event === "link" && model.link === "live") readCatalogue();
      },
    };
  },
});
