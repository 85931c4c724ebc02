// The audit log: changes made through this node, for operators; fetched when it is opened.
import { createElement, updateList, setText } from "./element.js";

const SHOWN = 50;

function createRow() {
  return createElement("li", {}, createElement("time"), createElement("b"), createElement("span"), createElement("span", { class: "hint" }));
}

function updateRow(item, line) {
  const [time, who, what, how] = item.children;
  const at = new Date(1000 * line.at);
  time.dateTime = at.toISOString();
  setText(time, at.toLocaleTimeString());
  setText(who, line.who || line.role);
  setText(what, `${line.route.replace("/api/v1/", "")}${line.target ? ` (${line.target})` : ""}`);
  setText(how, `${line.outcome}, from ${line.from}${line.repeated ? `, and ${line.repeated} times more before` : ""}`);
}

export function make(root, { get }) {
  const list = createElement("ol", { class: "audit" });
  const line = createElement("p", { role: "status" });
  const again = createElement("button", { type: "button" }, "Refresh");
  const box = createElement("details", {}, createElement("summary", {}, "Audit log"), line, list, again);
  async function load() {
    try {
      const lines = await get(`audit?count=${SHOWN}`);
      updateList(list, lines, (each) => `${each.at} ${each.session} ${each.route} ${each.target}`, createRow, updateRow);
      setText(line, lines.length ? "" : "No changes so far.");
    } catch (error) {
      setText(line, error.message);
    }
  }
  box.ontoggle = () => { if (box.open) load(); };
  again.onclick = load;
  root.append(box);
  return {};
}
