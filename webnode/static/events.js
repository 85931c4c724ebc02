// Events: what this node saw happen in the team, all of it or of one kind.
import { at, words } from "./element.js";
import { listEntries, since } from "./history.js";

const KINDS = {
  all: () => true,
  faults: ({ kind }) => ["fault", "gone", "back", "takeover", "handover", "halt"].includes(kind),
  tasks: ({ kind }) => ["task", "agreed", "takeover", "handover"].includes(kind),
  messages: ({ kind }) => kind === "message",
};

export function make(root, { model }) {
  const show = () => {
    const entries = model.events.filter(KINDS[at("event-kind").value]);
    words(at("events-since"), `${model.node ? `What ${model.node} saw` : "What was seen"} ${since(model.events)}`.trim());
    listEntries(at("events"), entries);
  };
  at("event-kind").addEventListener("change", show);
  return {
    update(_, event) {
      if (["", "event", "state"].includes(event)) show();
    },
  };
}
