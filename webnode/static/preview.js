// Preview: below the choice of a task, who could take it and who not, and why, before anything is assigned.
import { alike, at, element, keyed, several } from "./element.js";
import { ask } from "./link.js";

const PAUSE = 400;
const NOBODY = { able: [], refused: {}, likely: null, together: [] };

function lines({ able, refused, likely, together }, group) {
  const could = several(able.map(({ name, busy }) => (busy ? `${name} (now: ${busy})` : name)));
  const who = likely ? `${likely} is the nearest by what is reported now.` : "Which of them is decided once they have looked.";
  const yes = able.length ? [["can", `${could}. ${able.length > 1 ? who : ""}`.trim()]] : [["nobody", "No device here can take it."]];
  const others = together.map(({ title }) => title).join(", ");
  const divided = group ? [["with", others ? `${others}.` : `nothing yet; it begins the group ${group}.`]] : [];
  return [...yes, ...divided, ...alike(refused).map(([names, why]) => ["cannot", `${several(names)}: ${why}`])];
}

const SAID = { can: "Can take it: ", cannot: "Cannot: ", nobody: "", with: "Divided together with: " };

export function make(root, { model }) {
  const list = element("ul", { class: "preview", "aria-label": "Who could take this task" });
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

  // What is known of the devices changes in bursts: it is asked once after each.
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
