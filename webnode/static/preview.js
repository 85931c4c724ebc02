// Preview: shows, before a task is assigned, which devices can take it and why others cannot.
import { alike, at, element, keyed, several } from "./element.js";
import { ask } from "./link.js";

const PAUSE = 400;
const NOBODY = { able: [], refused: {}, likely: null, together: [] };

function lines({ able, refused, likely, together }, group) {
  const could = several(able.map(({ name, busy }) => (busy ? `${name} (now: ${busy})` : name)));
  const who = likely ? `${likely} is the nearest by present reports.` : "The nearest is chosen when they have reported.";
  const yes = able.length ? [["can", `${could}. ${able.length > 1 ? who : ""}`.trim()]] : [["nobody", "No device here can take it."]];
  const others = together.map(({ title }) => title).join(", ");
  const divided = group ? [["with", others ? `${others}.` : `no other task yet; this is the first of group ${group}.`]] : [];
  return [...yes, ...divided, ...alike(refused).map(([names, why]) => ["cannot", `${several(names)}: ${why}`])];
}

const SAID = { can: "Can take it: ", cannot: "Cannot: ", nobody: "", with: "Divided together with: " };

export function make(root, { model }) {
  const list = element("ul", { class: "preview", "aria-label": "Devices that can take this task" });
  let told = "";
  let due = 0;
  root.append(list);
  at("assign")?.after(root);

  function show(preview, group) {
    const rows = lines(preview, group);
    if (told === JSON.stringify(rows)) return;
    told = JSON.stringify(rows);
    list.replaceChildren(...rows.map(([kind, text]) => element("li", { "data-can": kind }, element("b", {}, SAID[kind]), text)));
  }

  // Changes of devices come in bursts: request once after each burst.
  function later() {
    clearTimeout(due);
    due = setTimeout(async () => {
      const [name, group] = [at("task").value, at("group").value.trim()];
      if (!name || model.link !== "live") return;
      const body = { name, ...(group && { group }) };
      show(await ask("POST", "tasks/preview", body).catch(() => NOBODY), group);
    }, PAUSE);
  }

  let seen = "";
  const chosen = (event) => { if (["task", "group"].includes(event.target.id)) later(); };
  document.addEventListener("input", chosen);
  return {
    update(_, event) {
      if (event === "yard") return;
      const now = JSON.stringify([[...model.devices.values()].map((device) => [device.uuid, device.gone, device.task]), [...model.tasks.values()].map((task) => [task.group, task.status]), at("task").value, model.link]);
      if (now !== seen) later();
      seen = now;
      const groups = [...new Set([...model.tasks.values()].map(({ group }) => group).filter(Boolean))];
      keyed(at("groups-known"), groups, (name) => name, (value) => element("option", { value }), () => {});
    },
    close() {
      clearTimeout(due);
      document.removeEventListener("input", chosen);
    },
  };
}
