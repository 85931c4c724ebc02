// Settings of a device: a field for each one that the device reports, and a button that sends the changes.
import { element, words } from "./element.js";
import { wish } from "./desk.js";
import { get } from "./link.js";

let number = 0;

// A field for one setting: its row, its present value, and whether it was changed.
function field({ key, value, about, unit, least, most }) {
  const id = `setting-${++number}`;
  const isTable = typeof value === "object" && value !== null;
  const shown = isTable ? JSON.stringify(value, null, 1) : String(value ?? "");
  const input = element(isTable ? "textarea" : "input", { id, name: key });
  if (isTable) input.rows = Math.min(8, shown.split("\n").length);
  if (typeof value === "number") Object.assign(input, { type: "number", step: "any", min: least ?? "", max: most ?? "", required: true });
  else if (!isTable && most) input.maxLength = most;
  input.value = shown;
  const range = typeof value === "number" && least !== null && most !== null ? `, ${least} to ${most}` : "";
  return {
    key,
    row: element("div", { class: "knob" }, element("label", { for: id }, `${about}${unit ? ` (${unit}${range})` : range}`), input),
    isChanged: () => input.value !== shown,
    value: () => (isTable ? JSON.parse(input.value) : typeof value === "number" ? Number(input.value) : input.value),
  };
}

export function make(root, { model }) {
  const form = element("form", { class: "settings" });
  const line = element("p", { role: "status", class: "hint" });
  const save = element("button", {}, "Save settings");
  let uuid = "";
  let fields = [];
  root.append(element("h3", {}, "Settings"), form, line);

  function fill(knobs) {
    fields = knobs.map(field);
    const may = model.me.role === "operator";
    form.replaceChildren(...fields.map(({ row }) => row), ...(may && fields.length ? [save] : []));
    for (const input of form.querySelectorAll("input, textarea")) input.readOnly = !may;
    if (!knobs.length) words(line, "This device has no settings that can be changed.");
  }

  async function load() {
    const asked = uuid;
    form.replaceChildren();
    words(line, "Querying the device …");
    try {
      const knobs = await get(`devices/${asked}/settings`);
      if (asked !== uuid) return;
      words(line, "");
      fill(knobs);
    } catch (error) {
      if (asked === uuid) words(line, error.message);
    }
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    let body = {};
    for (const each of fields.filter(({ isChanged }) => isChanged())) {
      try {
        body[each.key] = each.value();
      } catch {
        return words(line, `${each.key}: not a table; write for example {"gripper": {"width": 0.1}}.`);
      }
    }
    if (!Object.keys(body).length) return words(line, "No changes to save.");
    const done = (knobs) => {
      fill(knobs);
      return "Settings saved.";
    };
    wish("Saving", `devices/${uuid}/settings`, { method: "PUT", body, line: (text) => words(line, text), done });
  });

  return {
    show(argument) {
      uuid = argument;
      load();
    },
    hide() {
      uuid = "";
    },
  };
}
