// The model: what the page knows, as it came last; the panels read it and never write it.
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
  link: "wait",
  now: 0,
};

const byKey = (rows, key) => new Map(rows.map((row) => [row[key], row]));

// Take what the stream says; maps keep the order of the node's lists.
const TAKERS = {
  state(state) {
    model.node = state.node || model.node;
    model.devices = byKey(state.devices, "uuid");
    model.tasks = byKey(state.tasks, "id");
    model.groups = byKey(state.groups, "task");
    model.halted = state.halted === true;
  },
  yard(snapshot) {
    model.yard = snapshot;
    model.has = [...model.has.filter((name) => name !== "yard"), ...(snapshot ? ["yard"] : [])];
  },
  beat({ now }) {
    model.now = now;
  },
  session(me) {
    model.me = me;
    document.body.dataset.role = me.role;
  },
  link(state) {
    model.link = state;
  },
};

export function take(event, data) {
  TAKERS[event]?.(data);
}
