// Panels of faults: loaded only for operators of a team with fault injection.
import { get } from "./connection.js";
import { registerPanel } from "./panel.js";

const needs = { role: "operator" };
let known;

// The node lists the kinds of faults; the list is empty if fault injection is off on the node.
const loadFaults = async (name) => {
  known ??= get("faults").catch(() => ({ kinds: [] }));
  const { kinds } = await known;
  return { make: kinds.length ? (await import("./faults.js"))[name] : () => ({}) };
};

registerPanel({ place: "devices", order: 90, needs, load: () => loadFaults("createTakeovers") });
registerPanel({ place: "device", order: 60, needs, load: () => loadFaults("createButtons") });
