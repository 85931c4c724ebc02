// Preview: below the choice of a task, who could take it and who not, and why, before anything is assigned.
import { at, element } from "./element.js";
import { ask } from "./link.js";

const PAUSE = 400;
const NOBODY = { able: [], refused: {}, likely: null };

function lines({ able, refused, likely }) {
  const could = able.map(({ name, busy }) => (busy ? `${name} (now: ${busy})` : name)).join(", ");
  const who = likely ? `${likely} is the nearest by what is reported now.` : "Which of them is decided once they have looked.";
  const yes = able.length ? [["can", `${could}. ${able.length > 1 ? who : ""}`.trim()]] : [["nobody", "No device here can take it."]];
  return [...yes, ...Object.entries(refused).map(([name, why]) => ["cannot", `${name}: ${[].concat(why).join(", ")}`])];
}

const SAID = { can: "Can take it: ", cannot: "Cannot: ", nobody: "" };

export function make(root, { model }) {
  const list = element("ul", { class: "preview", "aria-label": "Who could take this task" });
  let told = "";
  let due = 0;
  root.append(list);
  at("assign")?.after(root);

  function show(preview) {
    const rows = lines(preview);
    if (told === JSON.stringify(rows)) return;
    told = JSON.stringify(rows);
    list.replaceChildren(...rows.map(([kind, text]) => element("li", { "data-can": kind }, element("b", {}, SAID[kind]), text)));
  }

  // What is known of the devices changes in bursts: it is asked once after each.
  function later() {
    clearTimeout(due);
    due = setTimeout(async () => {
      const name = at("task")?.value;
      if (name && model.link === "live") show(await ask("POST", "tasks/preview", { name }).catch(() => NOBODY));
    }, PAUSE);
  }

  let seen = "";
  const chosen = (event) => { if (event.target.id === "task") later(); };
  document.addEventListener("change", chosen);
  return {
    update(_, event) {
      if (event === "yard") return;
      const now = JSON.stringify([[...model.devices.values()].map((device) => [device.uuid, device.gone, device.task]), at("task")?.value, model.link]);
      if (now !== seen) later();
      seen = now;
    },
    close() {
      clearTimeout(due);
      document.removeEventListener("change", chosen);
    },
  };
}
