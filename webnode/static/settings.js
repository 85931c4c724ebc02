// Settings of a device: a field for each one that the device reports, and a button that sends the changes.
import { createElement, setText } from "./element.js";
import { sendRequest } from "./request.js";
import { get } from "./connection.js";

let number = 0;

// A field for one setting: its row, its present value, and whether it was changed.
function createField({ key, value, about, unit, least, most }) {
  const id = `setting-${++number}`;
  const isTable = typeof value === "object" && value !== null;
  const shown = isTable ? JSON.stringify(value, null, 1) : String(value ?? "");
  const input = createElement(isTable ? "textarea" : "input", { id, name: key });
  if (isTable) input.rows = Math.min(8, shown.split("\n").length);
  if (typeof value === "number") Object.assign(input, { type: "number", step: "any", min: least ?? "", max: most ?? "", required: true });
  else if (!isTable && most) input.maxLength = most;
  input.value = shown;
  const range = typeof value === "number" && least !== null && most !== null ? `, ${least} to ${most}` : "";
  return {
    key,
    row: createElement("div", { class: "setting" }, createElement("label", { for: id }, `${about}${unit ? ` (${unit}${range})` : range}`), input),
    isChanged: () => input.value !== shown,
    value: () => (isTable ? JSON.parse(input.value) : typeof value === "number" ? Number(input.value) : input.value),
  };
}

export function make(root, { model }) {
  const form = createElement("form", { class: "settings" });
  const line = createElement("p", { role: "status", class: "hint" });
  const save = createElement("button", {}, "Save settings");
  let uuid = "";
  let fields = [];
  root.append(createElement("h3", {}, "Settings"), form, line);

  function fill(settings) {
    fields = settings.map(createField);
    const may = model.me.role === "operator";
    form.replaceChildren(...fields.map(({ row }) => row), ...(may && fields.length ? [save] : []));
    for (const input of form.querySelectorAll("input, textarea")) input.readOnly = !may;
    if (!settings.length) setText(line, "This device has no settings that can be changed.");
  }

  async function load() {
    const asked = uuid;
    form.replaceChildren();
    setText(line, "Querying the device …");
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
        return setText(line, `${each.key}: not a table; write for example {"gripper": {"width": 0.1}}.`);
      }
    }
    if (!Object.keys(body).length) return setText(line, "No changes to save.");
    const done = (settings) => {
      fill(settings);
      return "Settings saved.";
    };
    sendRequest("Saving", `devices/${uuid}/settings`, { method: "PUT", body, line: (text) => setText(line, text), done });
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
