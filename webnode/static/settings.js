// Settings of a device: a field for each setting that the device reports, and a button that sends the changes.
import { createElement, setText } from "./element.js";
import { sendRequest } from "./request.js";
import { get } from "./connection.js";
import { text, textOf } from "./texts.js";

let count = 0;

// A field for one setting: its row, its present value, and whether it was changed.
function createField({ key, value, about, unit, least, most }) {
  const id = `setting-${++count}`;
  const isTable = typeof value === "object" && value !== null;
  const shown = isTable ? JSON.stringify(value, null, 1) : String(value ?? "");
  const input = createElement(isTable ? "textarea" : "input", { id, name: key });
  if (isTable) input.rows = Math.min(8, shown.split("\n").length);
  if (typeof value === "number") Object.assign(input, { type: "number", step: "any", min: least ?? "", max: most ?? "", required: true });
  else if (!isTable && most) input.maxLength = most;
  input.value = shown;
  const range = typeof value === "number" && least !== null && most !== null ? text("settings.range", { least, most }) : "";
  const limits = [unit && textOf("settings.unit", unit.replace(" ", "_"), unit), range].filter(Boolean).join(", ");
  return {
    key,
    row: createElement("div", { class: "setting" }, createElement("label", { for: id }, textOf("settings.about", key, about) + (limits && ` (${limits})`)), input),
    isChanged: () => input.value !== shown,
    value: () => (isTable ? JSON.parse(input.value) : typeof value === "number" ? Number(input.value) : input.value),
  };
}

export function make(root, { model }) {
  const form = createElement("form", { class: "settings" });
  const line = createElement("p", { role: "status", class: "hint" });
  const save = createElement("button", {}, text("settings.save"));
  let uuid = "";
  let fields = [];
  root.append(createElement("h3", {}, text("settings.title")), form, line);

  function fill(settings) {
    fields = settings.map(createField);
    const may = model.me.role === "operator";
    form.replaceChildren(...fields.map(({ row }) => row), ...(may && fields.length ? [save] : []));
    for (const input of form.querySelectorAll("input, textarea")) input.readOnly = !may;
    if (!settings.length) setText(line, text("settings.none"));
  }

  async function load() {
    const asked = uuid;
    form.replaceChildren();
    setText(line, text("device.querying"));
    try {
      const settings = await get(`devices/${asked}/settings`);
      if (asked !== uuid) return;
      setText(line, "");
      fill(settings);
    } catch (error) {
      if (asked === uuid) setText(line, error.message);
    }
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    let body = {};
    for (const each of fields.filter(({ isChanged }) => isChanged())) {
      try {
        body[each.key] = each.value();
      } catch {
        return setText(line, text("settings.not_a_table", { name: each.key, example: '{"gripper": {"width": 0.1}}' }));
      }
    }
    if (!Object.keys(body).length) return setText(line, text("settings.no_changes"));
    const done = (settings) => {
      fill(settings);
      return text("settings.saved");
    };
    sendRequest(text("settings.saving"), `devices/${uuid}/settings`, { method: "PUT", body, line: (message) => setText(line, message), done });
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
