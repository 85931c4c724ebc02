// History: what happened, or what happened to one device or task, the newest first.
import { attribute, element, keyed, words } from "./element.js";
import { get } from "./link.js";
import { model } from "./model.js";

const SHOWN = 100;
const clock = (at) => new Date(at * 1000).toLocaleTimeString([], { hourCycle: "h23" });

// Entries of the chronicle in a list; one without any says so.
export function listEntries(list, entries) {
  const newest = entries.slice(-SHOWN).reverse();
  const none = { n: 0, at: 0, kind: "none", text: "Nothing so far." };
  keyed(list, newest.length ? newest : [none], (entry) => entry.n, () => element("li", {}, element("time"), " ", element("span")),
    (item, entry) => {
      attribute(item, "data-kind", entry.kind);
      words(item.firstChild, entry.at ? clock(entry.at) : "");
      words(item.lastChild, entry.text);
    });
}

// From when on is told what is told: a node knows nothing of what was before it looked.
export const since = (entries) => (entries.length ? `since ${clock(entries[0].at)}` : "");

// The history of one device or task: what the node remembers, and then whatever comes.
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
