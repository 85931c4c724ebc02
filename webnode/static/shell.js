// The shell: opens panels at their places, passes events to them, and switches views.
import { byId } from "./element.js";
import { panels } from "./panel.js";

const RETRY_MS = 3000;
// A phone sees the same as a viewer.
const RANKS = { anyone: 0, viewer: 1, phone: 2, operator: 3 };
const shown = new Map();
let shared = {};
let lastPlace = "";
// A narrow screen shows one of these views at a time, with a navigation bar; ?view=cameras shows one view alone.
const VIEWS = ["devices", "tasks", "cameras", "map", "groups", "network", "events", "phone", "more"];
const NARROW = matchMedia("(max-width: 43.99rem)");
const only = new URLSearchParams(location.search).get("view");

// Show a view: go("device/UUID"); go("") shows the first view, and back() the view before a device was opened.
export function go(view) {
  if (view) location.hash = view;
  else if (location.hash) {
    history.pushState(null, "", location.pathname + location.search);
    followLocation();
  }
}

export const back = () => go(currentView() === VIEWS[0] ? "" : currentView());

const currentView = () => document.body.dataset.view ?? VIEWS[0];

// Mark the views that are not shown; the style sheet decides on which screens they are hidden.
function markView(name) {
  document.body.dataset.view = name;
  document.body.toggleAttribute("data-only", VIEWS.includes(only));
  for (const each of VIEWS) {
    const place = byId(`place-${each}`);
    place?.classList.toggle("other", each !== name && !(name === "tasks" && each === "groups"));
    place?.classList.toggle("aside", VIEWS.includes(only) && each !== only);
  }
  for (const link of document.querySelectorAll("#views a")) {
    if (link.hash === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}

function isWanted({ place, needs = {} }) {
  const { me, has } = shared.model;
  const mayLook = RANKS[me.role] >= RANKS[needs.role ?? "anyone"];
  return byId(`place-${place}`) && mayLook && (!needs.has || has.includes(needs.has));
}

async function open(panel) {
  const place = byId(`place-${panel.place}`);
  const root = panel.order ? document.createElement("div") : place;
  const entry = { panel, root, handlers: {} };
  shown.set(panel, entry);
  if (root !== place) {
    root.dataset.order = panel.order;
    place.insertBefore(root, [...place.children].find((other) => Number(other.dataset.order) > panel.order) ?? null);
  }
  let { make } = panel;
  try {
    make ??= (await panel.load()).make;
  } catch {
    // The node is gone, or too busy to send the module: try again later.
    setTimeout(() => shown.get(panel) === entry && close(entry), RETRY_MS);
    return;
  }
  if (shown.get(panel) !== entry) return;
  entry.handlers = make(root, shared) ?? {};
  entry.handlers.update?.(shared.model, "");
  const [name, argument] = parseLocation();
  if (name === panel.place) entry.handlers.show?.(argument);
}

function close(entry) {
  shown.delete(entry.panel);
  entry.handlers.close?.();
  if (entry.panel.order) entry.root.remove();
}

function parseLocation() {
  const [name, ...rest] = location.hash.slice(1).split("/");
  return [name, rest.join("/")];
}

function followLocation() {
  const [name, argument] = parseLocation();
  for (const { panel, handlers } of shown.values()) {
    if (panel.place === name) handlers.show?.(argument);
    else if (panel.place === lastPlace) handlers.hide?.();
  }
  if (VIEWS.includes(name)) {
    markView(name);
    if (NARROW.matches) scrollTo(0, 0);
    else byId(`place-${name}`)?.scrollIntoView();
  } else if (!name || !document.body.dataset.view) markView(VIEWS[0]);
  lastPlace = name;
}

// Open the panels that the visitor may see, and close the others.
function updatePanels() {
  for (const panel of panels) {
    const entry = shown.get(panel);
    if (!entry && isWanted(panel)) open(panel);
    else if (entry && !isWanted(panel)) close(entry);
  }
}

export function startPanels(tools) {
  shared = tools;
  addEventListener("hashchange", followLocation);
  updatePanels();
  followLocation();
}

// Pass an event to all panels; an error in one panel does not affect the others.
export function notifyPanels(event) {
  updatePanels();
  for (const { handlers } of [...shown.values()]) {
    try {
      handlers.update?.(shared.model, event);
    } catch (fault) {
      reportError(fault);
    }
  }
}
