// Events: the changes that this node observed in the team, all or by kind.
import { byId, setText } from "./element.js";
import { describeStart, listEntries } from "./history.js";
import { text } from "./texts.js";

const KINDS = {
  all: () => true,
  faults: ({ kind }) => ["fault", "gone", "back", "takeover", "handover", "halt"].includes(kind),
  tasks: ({ kind }) => ["task", "agreed", "takeover", "handover"].includes(kind),
  messages: ({ kind }) => kind === "message",
};

export function make(root, { model }) {
  const show = () => {
    const entries = model.events.filter(KINDS[byId("event-kind").value]);
    setText(byId("events-since"), [text("events.observed", { node: model.node || text("connection.this_node") }), describeStart(model.events)].join(" ").trim());
    listEntries(byId("events"), entries);
  };
  byId("event-kind").addEventListener("change", show);
  return {
    update(_, event) {
      if (["", "event", "state"].includes(event)) show();
    },
  };
}
