// Elements: create them, and update lists of elements without rebuilding an element that the user is using.
import { text, textOf } from "./texts.js";

const SVG = "http://www.w3.org/2000/svg";

export const byId = (id) => document.getElementById(id);

export function createElement(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

export function createSvg(tag, attributes = {}, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// Change a text only if it differs, so that a screen reader does not repeat it.
export function setText(node, value) {
  if (node.textContent !== value) node.textContent = value;
}

export function setAttribute(node, name, value) {
  if (node.getAttribute(name) !== String(value)) node.setAttribute(name, value);
}

// One child per item, in order; `make` is called once for a new key, `update` each time.  Keys may repeat.
export function updateList(parent, items, key, make, update) {
  const old = new Map();
  for (const child of parent.children) old.set(child.dataset.key, [...(old.get(child.dataset.key) ?? []), child]);
  items.forEach((item, place) => {
    const name = String(key(item));
    let child = old.get(name)?.shift();
    if (!child) {
      child = make(item);
      child.dataset.key = name;
    }
    if (parent.children[place] !== child) parent.insertBefore(child, parent.children[place] ?? null);
    update(child, item);
  });
  for (const child of [...old.values()].flat()) child.remove();
}

// A shape for each state, so that a state does not depend on colour alone.
const SHAPES = {
  IDLE: "M8 2.5a5.5 5.5 0 1 0 .01 0zM8 5a3 3 0 1 1-.01 0z",
  ASSIGNED: "M8 1.5 14.5 8 8 14.5 1.5 8zM8 5 5 8l3 3 3-3z",
  OPEN: "M8 1.5 14.5 8 8 14.5 1.5 8zM8 5 5 8l3 3 3-3z",
  SEARCHING: "M6.5 1.5a5 5 0 1 0 2.8 9.1l3.6 3.6 1.6-1.6-3.6-3.6A5 5 0 0 0 6.5 1.5zm0 2.3a2.7 2.7 0 1 1-.01 0z",
  WAITING: "M3 2h3.6v12H3zM9.4 2H13v12H9.4z",
  EXECUTING: "M3 1.5 14 8 3 14.5z",
  DONE: "M6.3 13.6 1 8.3l2-2 3.3 3.2 6.7-6.7 2 2z",
  COMPLETED: "M6.3 13.6 1 8.3l2-2 3.3 3.2 6.7-6.7 2 2z",
  GONE: "M3.5 1.5 8 6l4.5-4.5 2 2L10 8l4.5 4.5-2 2L8 10l-4.5 4.5-2-2L6 8 1.5 3.5z",
  FAILED: "M3.5 1.5 8 6l4.5-4.5 2 2L10 8l4.5 4.5-2 2L8 10l-4.5 4.5-2-2L6 8 1.5 3.5z",
  CANCELLED: "M2 2h12v12H2zM4.5 4.5v7h7v-7z",
  UNKNOWN: "M6.8 11h2.4v2.5H6.8zM8 2a4 4 0 0 1 1.2 7.8H6.8V7.6H8A1.8 1.8 0 1 0 6.2 5.8H4A4 4 0 0 1 8 2z",
};

export const describeStatus = (status) => textOf("status", status, status.toLowerCase());

export function createBadge() {
  return createElement("span", { class: "badge" }, createSvg("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, createSvg("path")), createElement("span"));
}

export function setBadge(node, status) {
  setAttribute(node, "data-state", status);
  setAttribute(node.querySelector("path"), "d", SHAPES[status] ?? SHAPES.UNKNOWN);
  setText(node.lastChild, describeStatus(status));
}

// The first names, and the number of further ones.
export function joinNames(names, most = 8) {
  const more = names.length - most;
  return more > 1 ? text("list.more", { names: names.slice(0, most).join(", "), count: more }) : names.join(", ");
}

// Group names by equal reasons: [names, reasons] each.
export function groupByReason(refused) {
  const found = new Map();
  for (const [name, reasons] of Object.entries(refused)) {
    const why = [].concat(reasons).join(", ");
    found.set(why, [...(found.get(why) ?? []), name]);
  }
  return [...found].map(([why, names]) => [names, why]);
}

export function formatDuration(seconds) {
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return text("duration.seconds", { count: s });
  if (s < 3600) return text("duration.minutes", { count: Math.floor(s / 60) });
  return s < 86400 ? text("duration.hours", { count: Math.floor(s / 3600) }) : text("duration.days", { count: Math.floor(s / 86400) });
}

// The time since a device joined or left.
export const formatPresence = ({ gone, since }, now) => (gone === null ? text("device.here", { time: formatDuration(now - since) }) : text("device.gone", { time: formatDuration(now - gone) }));
