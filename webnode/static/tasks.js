// Tasks: assign a predefined task, show the state of each task, and cancel, pause or resume a task.
import { groupByReason, byId, setAttribute, createBadge, createElement, updateList, joinNames, setBadge, setText } from "./element.js";
import { showStatus, sendRequest } from "./request.js";
import { send, get } from "./connection.js";
import { registerPanel } from "./panel.js";
import { formatNumber, text } from "./texts.js";

const ENDED = ["COMPLETED", "FAILED", "CANCELLED"];
const SHOWN = 8;
const histories = new Map();

function showTasks(tasks) {
  byId("no-tasks").hidden = tasks.length > 0;
  updateList(byId("tasks"), tasks.slice(0, SHOWN), (task) => task.id, createRow, (item, task) => {
    setText(item.querySelector("b"), task.title);
    setBadge(item.querySelector(".badge"), task.status);
    const result = task.result ? text("tasks.result", { name: task.result.by, seconds: formatNumber(task.result.took, 1) }) : "";
    setText(item.querySelector(".note"), [task.group && text("tasks.group", { name: task.group }), result, task.note].filter(Boolean).join(" "));
    showDecisions(item.querySelector(".why"), task.why);
    const [button, rest] = item.querySelectorAll("button");
    button.hidden = rest.hidden = ENDED.includes(task.status);
    button.setAttribute("aria-label", text("tasks.cancel_label", { title: task.title }));
    rest.dataset.paused = task.paused;
    setText(rest, text(task.paused ? "tasks.resume" : "tasks.pause"));
    rest.setAttribute("aria-label", text(task.paused ? "tasks.resume_label" : "tasks.pause_label", { title: task.title }));
  });
}

function createRow(task) {
  const button = createElement("button", {}, text("tasks.cancel"));
  button.addEventListener("click", () => sendRequest(text("tasks.cancelling", { title: task.title }), `tasks/${encodeURIComponent(task.id)}/cancel`));
  const rest = createElement("button", {}, text("tasks.pause"));
  rest.addEventListener("click", () => {
    const isPaused = rest.dataset.paused === "true";
    sendRequest(text(isPaused ? "tasks.resuming" : "tasks.pausing", { title: task.title }), `tasks/${encodeURIComponent(task.id)}/${isPaused ? "resume" : "pause"}`);
  });
  return createElement("li", {}, createElement("b"), createBadge(), createElement("span", { class: "note" }),
    createElement("details", { class: "why" }, createElement("summary"), createElement("div")), createHistory(task), button, rest);
}

// The history of a task, loaded when it is opened.
function createHistory(task) {
  const list = createElement("ol", { class: "story", tabindex: 0, "aria-label": text("tasks.history_label", { title: task.title }) });
  const box = createElement("details", { class: "history" }, createElement("summary", {}, text("history.title")), list);
  box.addEventListener("toggle", async () => {
    const { History } = await import("./history.js");
    if (box.open) histories.set(task.id, new History(list, task.id));
    else histories.delete(task.id);
  });
  return box;
}

// The decisions on a task: the newest in one line; when opened, all decisions with their rules and reports.
function showDecisions(box, epochs) {
  box.hidden = !epochs.length;
  const told = JSON.stringify(epochs);
  if (box.hidden || box.dataset.told === told) return;
  box.dataset.told = told;
  setText(box.firstChild, [text("consensus.agree", { name: epochs[0].chosen, count: epochs[0].agree, total: epochs[0].of }),
    ...epochs[0].differ.map((name) => text("consensus.differ", { names: name, count: 1 }))].join(", "));
  setAttribute(box, "data-agree", epochs[0].agree === epochs[0].of && !epochs[0].differ.length);
  box.lastChild.replaceChildren(...epochs.flatMap((each) => [
    createElement("p", {}, createElement("b", {}, `${each.epoch}. ${each.chosen}`), ` ${text(each.agreed ? "tasks.rule_agreed" : "tasks.rule", { rule: each.rule, reason: each.hysteresis, value: each.agreed })}`),
    createElement("table", {}, ...each.rows.map((row) => createElement("tr", {}, createElement("th", { scope: "row" }, row.name),
      createElement("td", {}, (Number.isFinite(row.cost) ? formatNumber(row.cost, 2) : text("tasks.no_report"))), createElement("td", {}, row.note)))),
    ...(each.reported > each.rows.length ? [text("tasks.of_reports", { count: each.reported })] : [])]));
}

function describeAssignment({ able = [], refused = {} }) {
  const no = groupByReason(refused).map(([names, why]) => text("tasks.not_possible", { names: joinNames(names), reason: why }));
  const yes = able.length ? [text("tasks.assigned_to", { names: joinNames(able) })] : [text(no.length ? "tasks.nobody" : "tasks.assigned")];
  return [...yes, ...no].join(" ");
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
    if (!byId("task").value) return showStatus(text("tasks.no_predefined"));
    const group = byId("group").value.trim();
    sendRequest(text("tasks.assigning"), "tasks", { body: { name: byId("task").value, ...(group && { group }) }, done: describeAssignment });
  });
  byId("demo").addEventListener("click", async () => {
    byId("demo").disabled = true;
    showStatus(text("demo.starting"));
    try {
      await send("POST", "demo");
      showStatus(text("demo.runs"));
    } catch (error) {
      showStatus(error.message);
    }
    byId("demo").disabled = false;
  });
}

registerPanel({
  place: "tasks",
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
