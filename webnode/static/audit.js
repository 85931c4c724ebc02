// The audit log: changes made through this node, for operators; fetched when it is opened.
import { createElement, updateList, setText } from "./element.js";
import { formatTime, text, textOf } from "./texts.js";

const SHOWN = 50;

function createRow() {
  return createElement("li", {}, createElement("time"), createElement("b"), createElement("span"), createElement("span", { class: "hint" }));
}

function updateRow(item, line) {
  const [time, who, what, how] = item.children;
  time.dateTime = new Date(1000 * line.at).toISOString();
  setText(time, formatTime(line.at));
  setText(who, line.who || textOf("role", line.role));
  setText(what, `${line.route.replace("/api/v1/", "")}${line.target ? ` (${line.target})` : ""}`);
  setText(how, text(line.repeated ? "audit.repeated" : "audit.outcome", { outcome: line.outcome, address: line.from, count: line.repeated }));
}

export function make(root, { get }) {
  const list = createElement("ol", { class: "audit" });
  const line = createElement("p", { role: "status" });
  const again = createElement("button", { type: "button" }, text("action.refresh"));
  const box = createElement("details", {}, createElement("summary", {}, text("audit.title")), line, list, again);
  async function load() {
    try {
      const lines = await get(`audit?count=${SHOWN}`);
      updateList(list, lines, (each) => `${each.at} ${each.session} ${each.route} ${each.target}`, createRow, updateRow);
      setText(line, lines.length ? "" : text("audit.none"));
    } catch (error) {
      setText(line, error.message);
    }
  }
  box.ontoggle = () => { if (box.open) load(); };
  again.onclick = load;
  root.append(box);
  return {};
}
