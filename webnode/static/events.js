// Events: the changes that this node observed in the team, all or by kind.
import { byId, setText } from "./element.js";
import { describeStart, listEntries } from "./history.js";

const KINDS = {
  all: () => true,
  faults: ({ kind }) => ["fault", "gone", "back", "takeover", "handover", "halt"].includes(kind),
  tasks: ({ kind }) => ["task", "agreed", "takeover", "handover"].includes(kind),
  messages: ({ kind }) => kind === "message",
};

export function make(root, { model }) {
  const show = () => {
    const entries = model.events.filter(KINDS[byId("event-kind").value]);
    setText(byId("events-since"), `${model.node ? `Observed by ${model.node}` : "Observed"} ${describeStart(model.events)}`.trim());
    listEntries(byId("events"), entries);
  };
  byId("event-kind").addEventListener("change", show);
  return {
    update(_, event) {
      if (["", "event", "state"].includes(event)) show();
    },
  };
}
