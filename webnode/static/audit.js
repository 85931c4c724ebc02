// The audit log: changes made through this node, for operators; fetched when it is opened.
import { element, keyed, words } from "./element.js";

const SHOWN = 50;

function row() {
  return element("li", {}, element("time"), element("b"), element("span"), element("span", { class: "hint" }));
}

function tell(item, line) {
  const [time, who, what, how] = item.children;
  const at = new Date(1000 * line.at);
  time.dateTime = at.toISOString();
  words(time, at.toLocaleTimeString());
  words(who, line.who || line.role);
  words(what, `${line.route.replace("/api/v1/", "")}${line.target ? ` (${line.target})` : ""}`);
  words(how, `${line.outcome}, from ${line.from}${line.repeated ? `, and ${line.repeated} times more before` : ""}`);
}

export function make(root, { get }) {
  const list = element("ol", { class: "audit" });
  const line = element("p", { role: "status" });
  const again = element("button", { type: "button" }, "Refresh");
  const box = element("details", {}, element("summary", {}, "Audit log"), line, list, again);
  async function look() {
    try {
      const lines = await get(`audit?count=${SHOWN}`);
      keyed(list, lines, (each) => `${each.at} ${each.session} ${each.route} ${each.target}`, row, tell);
      words(line, lines.length ? "" : "No changes so far.");
    } catch (error) {
      words(line, error.message);
    }
  }
  box.ontoggle = () => { if (box.open) look(); };
  again.onclick = look;
  root.append(box);
  return {};
}
