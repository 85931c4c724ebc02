// Faults: buttons that inject faults into a device, and for each fault the time until another device takes over.
import { attribute, element, keyed, words } from "./element.js";
import { ask, get } from "./link.js";

const LABELS = {
  kill: "Kill", freeze: "Freeze", radio: "Cut radio", "one-way": "Mute radio",
  delay: "Delay 0.3 s", loss: "Lose 20 %", skew: "Skew clock 1 h", battery: "Low battery",
};
const IDLE = 5000;
const BUSY = 500;
const TICK = 100;
const IN_TIME = 2;
const views = new Set();
let told = { kinds: [], can: {}, active: [] };
let heard = 0;
let timer = 0;

const label = (kind) => LABELS[kind] ?? kind;
const isBusy = () => told.active.some((row) => row.watched || row.left_s > 0);

async function look() {
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
  timer = setTimeout(look, isBusy() ? BUSY : IDLE);
}

// Between two answers the times run locally.
setInterval(() => {
  if (isBusy() && !document.hidden) for (const draw of views) draw();
}, TICK);
document.addEventListener("visibilitychange", look);

function clock(row, passed) {
  if (row.takeover_s !== null) return [row.takeover_s <= IN_TIME ? "held" : "late", `${row.to} took over after ${row.takeover_s.toFixed(2)} s`];
  if (!row.task) return ["none", "had no task"];
  const isLost = told.kinds.find((kind) => kind.kind === row.kind)?.is_lost;
  if (row.watched && isLost) return ["runs", `no takeover yet: ${(row.since_s + passed).toFixed(1)} s`];
  return isLost ? ["late", "no takeover"] : ["none", "continues its task"];
}

function row() {
  return element("li", { class: "fault" }, element("b"), " ", element("span"), element("strong"));
}

function fill(item, fault) {
  const passed = (performance.now() - heard) / 1000;
  const left = Math.max(0, fault.left_s - passed);
  const [state, text] = clock(fault, passed);
  attribute(item, "data-clock", state);
  words(item.children[0], fault.name);
  const rest = fault.kind === "kill" ? "" : left > 0 ? `, ${Math.ceil(left)} s left` : ", over";
  words(item.children[1], `${label(fault.kind)}${rest}`);
  words(item.children[2], text);
}

const list = (parent, rows) => keyed(parent, rows, (fault) => fault.n, row, fill);

// The faults injected in the team, and their takeovers.
export function takeovers(root) {
  const rows = element("ol", { class: "faults" });
  const head = element("h3", {}, "Injected faults");
  root.append(head, rows);
  const draw = () => {
    root.hidden = told.active.length === 0;
    list(rows, told.active.slice(0, 6));
  };
  views.add(draw);
  draw();
  look();
  return { close: () => views.delete(draw) };
}

// The buttons of one device.
export function buttons(root) {
  let uuid = "";
  const seconds = element("input", { id: "f-seconds", type: "number", min: 1, max: 600, value: 15, required: "" });
  const grid = element("div", { class: "fault-buttons" });
  const line = element("p", { role: "status" });
  const rows = element("ol", { class: "faults" });
  const none = element("p", { class: "empty" }, "This device does not allow fault injection.");
  const form = element("form", {}, element("label", { for: "f-seconds" }, "Inject a fault for (seconds)"), seconds, grid);
  root.append(element("h3", {}, "Faults"), none, form, line, rows);

  async function cause(kind) {
    if (!seconds.reportValidity()) return;
    words(line, `${label(kind)} …`);
    try {
      const { seconds: lasts } = await ask("POST", `devices/${uuid}/faults`, { kind, seconds: Number(seconds.value) });
      words(line, kind === "kill" ? "The process is killed; its supervisor restarts it." : `${label(kind)}: for ${lasts} s, then it ends.`);
    } catch (error) {
      words(line, error.message);
    }
    look();
  }

  function draw() {
    const can = told.can[uuid] ?? [];
    none.hidden = can.length > 0;
    form.hidden = can.length === 0;
    keyed(grid, told.kinds.filter(({ kind }) => can.includes(kind)), ({ kind }) => kind,
      ({ kind, about, is_lost: isLost }) => {
        const button = element("button", { type: "button", title: about, ...(isLost ? { class: "danger" } : {}) }, label(kind));
        button.addEventListener("click", () => cause(kind));
        return button;
      }, () => {});
    list(rows, told.active.filter((fault) => fault.uuid === uuid).slice(0, 4));
  }

  form.addEventListener("submit", (event) => event.preventDefault());
  views.add(draw);
  return {
    show(argument) {
      uuid = argument;
      words(line, "");
      draw();
      look();
    },
    hide() {
      uuid = "";
    },
    close: () => views.delete(draw),
  };
}
