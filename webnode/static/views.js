// Views: the navigation to further views, and the panels that are loaded only if the node can fill them.
import { element } from "./element.js";
import { panel } from "./panel.js";
import { KEPT, theme } from "./theme.js";

const THEMES = { "light dark": "As the system", light: "Light", dark: "Dark" };
const MORE = { groups: "Consensus", network: "Network", events: "Events" };

function choose(theme) {
  document.documentElement.style.colorScheme = theme;
  try {
    localStorage.setItem(KEPT, theme);
  } catch {
    // Without storage the choice is lost with the page.
  }
}

// Links to views that are used less often, and the choice of colours.
function more(root) {
  const choice = element("select", { id: "theme" }, ...Object.entries(THEMES).map(([value, name]) => element("option", { value }, name)));
  choice.value = theme();
  choice.addEventListener("change", () => choose(choice.value));
  root.append(
    element("nav", { class: "further", "aria-label": "More views" },
      ...Object.entries(MORE).map(([place, name]) => element("a", { href: `#${place}` }, name))),
    element("div", { class: "row" }, element("label", { for: "theme" }, "Colours"), choice));
}

// The module for phones is loaded when the visitor opens its view.
function phone(root, tools) {
  const acts = {
    async show() {
      root.hidden = false;
      delete acts.show;
      const { make } = await import("./phone.js");
      Object.assign(acts, make(root, tools));
    },
  };
  return acts;
}

document.querySelector("main").before(element("section", { class: "phone", id: "place-phone", "aria-labelledby": "h-phone", hidden: "" },
  element("h2", { id: "h-phone" }, "This phone")));
panel({ place: "more", order: 30, title: "More", make: more });

panel({ place: "more", order: 35, title: "Take part", needs: { role: "phone", has: "phones" }, make(root, { go }) {
  const button = element("button", {}, "Take part with this device");
  button.onclick = () => go("phone");
  root.append(element("p", { class: "row" }, button));
} });
panel({ place: "phone", title: "This phone", needs: { role: "viewer", has: "phones" }, make: phone });
panel({ place: "events", title: "Events", load: () => import("./events.js") });
panel({ place: "network", order: 5, title: "Links", needs: { role: "viewer", has: "survey" }, load: () => import("./ways.js") });
panel({ place: "network", order: 7, title: "Team", needs: { role: "viewer", has: "survey" }, load: () => import("./membership.js") });
panel({ place: "network", order: 10, title: "Network", needs: { has: "survey" }, load: () => import("./network.js") });
panel({ place: "device", order: 10, title: "Records", needs: { has: "survey" }, load: () => import("./inventory.js") });
