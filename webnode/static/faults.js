// Faults: buttons that inject faults into a device, and for each fault the time until another device takes over.
import { setAttribute, createElement, updateList, setText } from "./element.js";
import { send, get } from "./connection.js";
import { formatNumber, text, textOf } from "./texts.js";

const IDLE = 5000;
const BUSY = 500;
const TICK = 100;
const IN_TIME = 2;
const views = new Set();
let told = { kinds: [], can: {}, active: [] };
let heard = 0;
let timer = 0;

const labelOf = (kind) => textOf("fault.kind", kind);
const isBusy = () => told.active.some((row) => row.watched || row.left_s > 0);

async function refresh() {
  clearTimeout(timer);
  if (!document.hidden) {
    try {
      told = await get("faults");
      heard = performance.now();
      for (const draw of views) draw();
    } catch {
      // The last answer stays on the page; the header shows that the node is lost.
    }
  }
  timer = setTimeout(refresh, isBusy() ? BUSY : IDLE);
}

// Between two answers the page advances the times itself.
setInterval(() => {
  if (isBusy() && !document.hidden) for (const draw of views) draw();
}, TICK);
document.addEventListener("visibilitychange", refresh);

function describeTakeover(row, passed) {
  if (row.takeover_s !== null) return [row.takeover_s <= IN_TIME ? "held" : "late", text("fault.takeover", { name: row.to, seconds: formatNumber(row.takeover_s, 2) })];
  if (!row.task) return ["none", text("fault.no_task")];
  const isLost = told.kinds.find((kind) => kind.kind === row.kind)?.is_lost;
  if (row.watched && isLost) return ["runs", text("fault.no_takeover_yet", { seconds: formatNumber(row.since_s + passed, 1) })];
  return isLost ? ["late", text("fault.no_takeover")] : ["none", text("fault.continues")];
}

function createRow() {
  return createElement("li", { class: "fault" }, createElement("b"), " ", createElement("span"), createElement("strong"));
}

function updateRow(item, fault) {
  const passed = (performance.now() - heard) / 1000;
  const left = Math.max(0, fault.left_s - passed);
  const [state, takeover] = describeTakeover(fault, passed);
  setAttribute(item, "data-clock", state);
  setText(item.children[0], fault.name);
  const name = labelOf(fault.kind);
  setText(item.children[1], fault.kind === "kill" ? name : text(left > 0 ? "fault.left" : "fault.over", { name, seconds: Math.ceil(left) }));
  setText(item.children[2], takeover);
}

const updateFaults = (parent, rows) => updateList(parent, rows, (fault) => fault.n, createRow, updateRow);

// The faults injected in the team, and their takeovers.
export function createTakeovers(root) {
  const rows = createElement("ol", { class: "faults" });
  const head = createElement("h3", {}, text("fault.injected"));
  root.append(head, rows);
  const draw = () => {
    root.hidden = told.active.length === 0;
    updateFaults(rows, told.active.slice(0, 6));
  };
  views.add(draw);
  draw();
  refresh();
  return { close: () => views.delete(draw) };
}

// The buttons of one device.
export function createButtons(root) {
  let uuid = "";
  const seconds = createElement("input", { id: "f-seconds", type: "number", min: 1, max: 600, value: 15, required: "" });
  const grid = createElement("div", { class: "fault-buttons" });
  const line = createElement("p", { role: "status" });
  const rows = createElement("ol", { class: "faults" });
  const none = createElement("p", { class: "empty" }, text("fault.not_allowed"));
  const form = createElement("form", {}, createElement("label", { for: "f-seconds" }, text("fault.seconds_label")), seconds, grid);
  root.append(createElement("h3", {}, text("fault.title")), none, form, line, rows);

  async function injectFault(kind) {
    if (!seconds.reportValidity()) return;
    setText(line, text("request.runs", { action: labelOf(kind) }));
    try {
      const { seconds: lasts } = await send("POST", `devices/${uuid}/faults`, { kind, seconds: Number(seconds.value) });
      setText(line, kind === "kill" ? text("fault.killed") : text("fault.lasts", { name: labelOf(kind), seconds: lasts }));
    } catch (error) {
      setText(line, error.message);
    }
    refresh();
  }

  function draw() {
    const can = told.can[uuid] ?? [];
    none.hidden = can.length > 0;
    form.hidden = can.length === 0;
    updateList(grid, told.kinds.filter(({ kind }) => can.includes(kind)), ({ kind }) => kind,
      ({ kind, about, is_lost: isLost }) => {
        const button = createElement("button", { type: "button", title: textOf("fault.about", kind, about), ...(isLost ? { class: "danger" } : {}) }, labelOf(kind));
        button.addEventListener("click", () => injectFault(kind));
        return button;
      }, () => {});
    updateFaults(rows, told.active.filter((fault) => fault.uuid === uuid).slice(0, 4));
  }

  form.addEventListener("submit", (event) => event.preventDefault());
  views.add(draw);
  return {
    show(argument) {
      uuid = argument;
      setText(line, "");
      draw();
      refresh();
    },
    hide() {
      uuid = "";
    },
    close: () => views.delete(draw),
  };
}
