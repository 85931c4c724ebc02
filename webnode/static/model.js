// The model: the newest data of the page; panels read it and never write it.
export const model = {
  node: "",
  api: 1,
  me: { name: "", role: "anyone" },
  has: [],
  devices: new Map(),
  tasks: new Map(),
  groups: new Map(),
  yard: null,
  events: [],
  pages: [],
  halted: false,
  halt: null,
  link: "wait",
  now: 0,
};

const byKey = (rows, key) => new Map(rows.map((row) => [row[key], row]));
const inOrder = (map, compare) => new Map([...map].sort(([, a], [, b]) => compare(a, b)));
const KEYS = { devices: "uuid", tasks: "id", groups: "task" };
const ENTRIES = 2000;

// Apply an event of the stream; maps keep the order of the node's lists.
const HANDLERS = {
  state(state) {
    // Another node numbers its events from its own start.
    if (state.node !== model.node) model.events = [];
    model.node = state.node || model.node;
    model.devices = byKey(state.devices, "uuid");
    model.tasks = byKey(state.tasks, "id");
    model.groups = byKey(state.groups, "task");
    model.halted = state.halted ?? false;
    model.halt = state.halt ?? null;
  },
  // New and changed rows, and the keys of removed rows; the order is the same as in the node's lists.
  change({ without = {}, ...changed }) {
    for (const [name, key] of Object.entries(KEYS)) {
      if (!changed[name] && !without[name]) continue;
      model[name] = new Map([...model[name], ...byKey(changed[name] ?? [], key)]);
      without[name]?.forEach((each) => model[name].delete(each));
    }
    if (changed.devices) model.devices = inOrder(model.devices, (a, b) => a.joined - b.joined || (a.uuid < b.uuid ? -1 : 1));
    if (changed.tasks) model.tasks = inOrder(model.tasks, (a, b) => b.created - a.created || (a.id < b.id ? -1 : 1));
    const places = [...model.tasks.keys()];
    if (changed.groups) model.groups = inOrder(model.groups, (a, b) => places.indexOf(a.task) - places.indexOf(b.task));
    model.node = changed.node ?? model.node;
    model.halted = changed.halted ?? model.halted;
    model.halt = changed.halt ?? model.halt;
  },
  pages(pages) {
    model.pages = pages;
  },
  event(entries) {
    const newest = model.events.at(-1)?.n ?? 0;
    model.events = [...model.events, ...entries.filter((entry) => entry.n > newest)].slice(-ENTRIES);
  },
  yard(snapshot) {
    model.yard = snapshot;
    model.has = [...model.has.filter((name) => name !== "yard"), ...(snapshot ? ["yard"] : [])];
  },
  beat({ now }) {
    model.now = now;
  },
  has(names) {
    model.has = [...names, ...(model.yard && !names.includes("yard") ? ["yard"] : [])];
  },
  session(me) {
    model.me = me;
    document.body.dataset.role = me.role;
  },
  link(state) {
    model.link = state;
  },
};

export function applyEvent(event, data) {
  HANDLERS[event]?.(data);
}
