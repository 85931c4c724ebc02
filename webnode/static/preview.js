// Preview: shows, before a task is assigned, which devices can take it and why others cannot.
import { groupByReason, byId, createElement, updateList, joinNames } from "./element.js";
import { send } from "./connection.js";

const PAUSE = 400;
const NOBODY = { able: [], refused: {}, likely: null, together: [] };

function describePreview({ able, refused, likely, together }, group) {
  const could = joinNames(able.map(({ name, busy }) => (busy ? `${name} (now: ${busy})` : name)));
  const who = likely ? `${likely} is the nearest by present reports.` : "The nearest is chosen when they have reported.";
  const yes = able.length ? [["can", `${could}. ${able.length > 1 ? who : ""}`.trim()]] : [["nobody", "No device here can take it."]];
  const others = together.map(({ title }) => title).join(", ");
  const divided = group ? [["with", others ? `${others}.` : `no other task yet; this is the first of group ${group}.`]] : [];
  return [...yes, ...divided, ...groupByReason(refused).map(([names, why]) => ["cannot", `${joinNames(names)}: ${why}`])];
}

const SAID = { can: "Can take it: ", cannot: "Cannot: ", nobody: "", with: "Divided together with: " };

export function make(root, { model }) {
  const list = createElement("ul", { class: "preview", "aria-label": "Devices that can take this task" });
  let told = "";
  let due = 0;
  root.append(list);
  byId("assign")?.after(root);

  function show(preview, group) {
    const rows = describePreview(preview, group);
    if (told === JSON.stringify(rows)) return;
    told = JSON.stringify(rows);
    list.replaceChildren(...rows.map(([kind, text]) => createElement("li", { "data-can": kind }, createElement("b", {}, SAID[kind]), text)));
  }

  // Changes of devices come in bursts: request once after each burst.
  function schedule() {
    clearTimeout(due);
    due = setTimeout(async () => {
      const [name, group] = [byId("task").value, byId("group").value.trim()];
      if (!name || model.link !== "live") return;
      const body = { name, ...(group && { group }) };
      show(await send("POST", "tasks/preview", body).catch(() => NOBODY), group);
    }, PAUSE);
  }

  let seen = "";
  const chosen = (event) => { if (["task", "group"].includes(event.target.id)) schedule(); };
  document.addEventListener("input", chosen);
  return {
    update(_, event) {
      if (event === "yard") return;
      const now = JSON.stringify([[...model.devices.values()].map((device) => [device.uuid, device.gone, device.task]), [...model.tasks.values()].map((task) => [task.group, task.status]), byId("task").value, model.link]);
      if (now !== seen) schedule();
      seen = now;
      const groups = [...new Set([...model.tasks.values()].map(({ group }) => group).filter(Boolean))];
      updateList(byId("groups-known"), groups, (name) => name, (value) => createElement("option", { value }), () => {});
    },
    close() {
      clearTimeout(due);
      document.removeEventListener("input", chosen);
    },
  };
}
