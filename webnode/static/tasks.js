// Tasks: assign a predefined one, show the state of each, and cancel, pause or resume it.
import { groupByReason, byId, setAttribute, createBadge, createElement, updateList, joinNames, setBadge, setText } from "./element.js";
import { showStatus, sendRequest } from "./request.js";
import { send, get } from "./connection.js";
import { registerPanel } from "./panel.js";

const ENDED = ["COMPLETED", "FAILED", "CANCELLED"];
const SHOWN = 8;
const histories = new Map();

function showTasks(tasks) {
  byId("no-tasks").hidden = tasks.length > 0;
  updateList(byId("tasks"), tasks.slice(0, SHOWN), (task) => task.id, createRow, (item, task) => {
    setText(item.querySelector("b"), task.title);
    setBadge(item.querySelector(".badge"), task.status);
    const result = task.result ? `Done by ${task.result.by} in ${task.result.took.toFixed(1)} s. ` : "";
    setText(item.querySelector(".note"), (task.group && `Group ${task.group}. `) + result + task.note);
    showDecisions(item.querySelector(".why"), task.why);
    const [button, rest] = item.querySelectorAll("button");
    button.hidden = rest.hidden = ENDED.includes(task.status);
    button.setAttribute("aria-label", `Cancel ${task.title}`);
    setText(rest, task.paused ? "Resume" : "Pause");
    rest.setAttribute("aria-label", `${rest.textContent} ${task.title}`);
  });
}

function createRow(task) {
  const button = createElement("button", {}, "Cancel");
  button.addEventListener("click", () => sendRequest(`Cancelling ${task.title}`, `tasks/${encodeURIComponent(task.id)}/cancel`));
  const rest = createElement("button", {}, "Pause");
  rest.addEventListener("click", () => {
    const isPaused = rest.textContent === "Resume";
    sendRequest(`${isPaused ? "Resuming" : "Pausing"} ${task.title}`, `tasks/${encodeURIComponent(task.id)}/${isPaused ? "resume" : "pause"}`);
  });
  return createElement("li", {}, createElement("b"), createBadge(), createElement("span", { class: "note" }),
    createElement("details", { class: "why" }, createElement("summary"), createElement("div")), createHistory(task), button, rest);
}

// The history of a task, loaded when it is opened.
function createHistory(task) {
  const list = createElement("ol", { class: "story", tabindex: 0, "aria-label": `History of ${task.title}, the newest first` });
  const box = createElement("details", { class: "history" }, createElement("summary", {}, "History"), list);
  box.addEventListener("toggle", async () => {
    const { History } = await import("./history.js");
    if (box.open) histories.set(task.id, new History(list, task.id));
    else histories.delete(task.id);
  });
  return box;
}

// The decisions on a task: the newest in one line; opened, each with its rule and the reports.
function showDecisions(box, epochs) {
  box.hidden = !epochs.length;
  const told = JSON.stringify(epochs);
  if (box.hidden || box.dataset.told === told) return;
  box.dataset.told = told;
  setText(box.firstChild, `${epochs[0].chosen} – ${epochs[0].agree} of ${epochs[0].of} agree${epochs[0].differ.map((name) => `, ${name} differs`).join("")}`);
  setAttribute(box, "data-agree", epochs[0].agree === epochs[0].of && !epochs[0].differ.length);
  box.lastChild.replaceChildren(...epochs.flatMap((each) => [
    createElement("p", {}, createElement("b", {}, `${each.epoch}. ${each.chosen}`), ` by ${each.rule}: ${each.hysteresis}${each.agreed && `; agreed on ${each.agreed}`}`),
    createElement("table", {}, ...each.rows.map((row) => createElement("tr", {}, createElement("th", { scope: "row" }, row.name),
      createElement("td", {}, row.cost?.toFixed(2) ?? "no report"), createElement("td", {}, row.note)))),
    ...(each.reported > each.rows.length ? [`of ${each.reported} reports`] : [])]));
}

function describeAssignment({ able = [], refused = {} }) {
  const no = groupByReason(refused).map(([names, why]) => `Not possible for ${joinNames(names)}: ${why}`);
  const yes = able.length ? [`Assigned to ${joinNames(able)}`] : no.length ? ["No device can take it"] : ["Assigned"];
  return `${[...yes, ...no].join(". ")}.`;
}

// The catalogue is read when the page connects or reconnects.
async function readCatalogue() {
  const catalogue = await get("catalogue").catch(() => null);
  if (!catalogue) return;
  const chosen = byId("task").value;
  byId("task").replaceChildren(...catalogue.map((task) => createElement("option", { value: task.name }, task.title || task.name)));
  if (chosen) byId("task").value = chosen;
}

function startTasks() {
  byId("assign").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!byId("task").value) return showStatus("There is no predefined task to assign.");
    const group = byId("group").value.trim();
    sendRequest("Assigning", "tasks", { body: { name: byId("task").value, ...(group && { group }) }, done: describeAssignment });
  });
  byId("demo").addEventListener("click", async () => {
    byId("demo").disabled = true;
    showStatus("Starting the demo …");
    try {
      await send("POST", "demo");
      showStatus("The demo runs.");
    } catch (error) {
      showStatus(error.message);
    }
    byId("demo").disabled = false;
  });
}

registerPanel({
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
