// History: events of the team, or of one device or task, newest first.
import { setAttribute, createElement, updateList, setText } from "./element.js";
import { get } from "./connection.js";
import { model } from "./model.js";
import { formatTime, text } from "./texts.js";

const SHOWN = 100;

// List events; an empty list gets a placeholder.
export function listEntries(list, entries) {
  const newest = entries.slice(-SHOWN).reverse();
  const none = { n: 0, at: 0, kind: "none", text: text("history.none") };
  updateList(list, newest.length ? newest : [none], (entry) => entry.n, () => createElement("li", {}, createElement("time"), " ", createElement("span")),
    (item, entry) => {
      setAttribute(item, "data-kind", entry.kind);
      setText(item.firstChild, entry.at ? formatTime(entry.at) : "");
      setText(item.lastChild, entry.text);
    });
}

// The start of the event log: a node has no earlier events.
export const describeStart = (entries) => (entries.length ? text("events.since", { time: formatTime(entries[0].at) }) : "");

// The history of one device or task: the entries that the node keeps, and later ones.
export class History {
  constructor(list, about) {
    this.list = list;
    this.about = about;
    this.known = new Map();
    get(`events?about=${encodeURIComponent(about)}`).catch(() => []).then((entries) => this.take(entries));
  }

  take(entries) {
    for (const entry of entries) {
      if ([entry.uuid, entry.task].includes(this.about)) this.known.set(`${entry.at}/${entry.n}`, entry);
    }
    listEntries(this.list, [...this.known.values()].sort((a, b) => a.at - b.at || a.n - b.n));
  }

  update() {
    this.take(model.events);
  }
}
