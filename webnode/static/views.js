// Views: the navigation to further views, and the panels that are loaded only if the node can fill them.
import { createElement } from "./element.js";
import { registerPanel } from "./panel.js";
import { STORAGE_KEY, readTheme } from "./theme.js";
import { text } from "./texts.js";

const THEMES = { "light dark": text("theme.system"), light: text("theme.light"), dark: text("theme.dark") };
const MORE = { groups: text("consensus.title"), network: text("network.title"), events: text("events.title") };

function setTheme(theme) {
  document.documentElement.style.colorScheme = theme;
  try {
    localStorage.setItem(STORAGE_KEY, theme);
  } catch {
    // Without storage the choice is lost with the page.
  }
}

// Links to views that are used less often, and the choice of colours.
function createMoreView(root) {
  const choice = createElement("select", { id: "theme" }, ...Object.entries(THEMES).map(([value, name]) => createElement("option", { value }, name)));
  choice.value = readTheme();
  choice.addEventListener("change", () => setTheme(choice.value));
  root.append(
    createElement("nav", { class: "further", "aria-label": text("views.more_label") },
      ...Object.entries(MORE).map(([place, name]) => createElement("a", { href: `#${place}` }, name))),
    createElement("div", { class: "row" }, createElement("label", { for: "theme" }, text("theme.label")), choice));
}

// The module for phones is loaded when the visitor opens its view.
function createPhoneView(root, tools) {
  const handlers = {
    async show() {
      root.hidden = false;
      delete handlers.show;
      const { make } = await import("./phone.js");
      Object.assign(handlers, make(root, tools));
    },
  };
  return handlers;
}

document.querySelector("main").before(createElement("section", { class: "phone", id: "place-phone", "aria-labelledby": "h-phone", hidden: "" },
  createElement("h2", { id: "h-phone" }, text("phone.title"))));
registerPanel({ place: "more", order: 30, make: createMoreView });

registerPanel({ place: "more", order: 35, needs: { role: "phone", has: "phones" }, make(root, { go }) {
  const button = createElement("button", {}, text("phone.join_device"));
  button.onclick = () => go("phone");
  root.append(createElement("p", { class: "row" }, button));
} });
registerPanel({ place: "phone", needs: { role: "viewer", has: "phones" }, make: createPhoneView });
registerPanel({ place: "events", load: () => import("./events.js") });
registerPanel({ place: "network", order: 5, needs: { role: "viewer", has: "survey" }, load: () => import("./paths.js") });
registerPanel({ place: "network", order: 7, needs: { role: "viewer", has: "survey" }, load: () => import("./membership.js") });
registerPanel({ place: "network", order: 10, needs: { has: "survey" }, load: () => import("./network.js") });
registerPanel({ place: "device", order: 10, needs: { has: "survey" }, load: () => import("./inventory.js") });
