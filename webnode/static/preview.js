// Preview: shows, before a task is assigned, which devices can take it and why others cannot.
import { groupByReason, byId, createElement, updateList, joinNames } from "./element.js";
import { send } from "./connection.js";
import { text } from "./texts.js";

const PAUSE = 400;
const NOBODY = { able: [], refused: {}, likely: null, together: [] };

function describePreview({ able, refused, likely, together }, group) {
  const could = joinNames(able.map(({ name, busy }) => (busy ? text("preview.busy", { name, task: busy }) : name)));
  const who = likely ? text("preview.likely", { name: likely }) : text("preview.not_reported");
  const yes = able.length ? [["can", `${could}. ${able.length > 1 ? who : ""}`.trim()]] : [["nobody", text("preview.nobody")]];
  const others = together.map(({ title }) => title).join(", ");
  const divided = group ? [["with", others ? `${others}.` : text("preview.first_of_group", { group })]] : [];
  return [...yes, ...divided, ...groupByReason(refused).map(([names, why]) => ["cannot", `${joinNames(names)}: ${why}`])];
}

const HEADS = { can: text("preview.can"), cannot: text("preview.cannot"), with: text("preview.with") };

export function make(root, { model }) {
  const list = createElement("ul", { class: "preview", "aria-label": text("preview.label") });
  let told = "";
  let due = 0;
  root.append(list);
  byId("assign")?.after(root);

  function show(preview, group) {
    const rows = describePreview(preview, group);
    if (told === JSON.stringify(rows)) return;
    told = JSON.stringify(rows);
    list.replaceChildren(...rows.map(([kind, line]) => createElement("li", { "data-can": kind }, ...(HEADS[kind] ? [createElement("b", {}, HEADS[kind]), " "] : []), line)));
  }

  // Devices change in bursts: send one request after each burst.
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
