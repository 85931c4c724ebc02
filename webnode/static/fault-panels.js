// Panels of faults: loaded only for operators of a team with fault injection.
import { get } from "./link.js";
import { panel } from "./panel.js";

const needs = { role: "operator" };
let known;

// The node lists the kinds of faults; the list is empty if it does not inject faults.
const faults = async (name) => {
  known ??= get("faults").catch(() => ({ kinds: [] }));
  const { kinds } = await known;
  return { make: kinds.length ? (await import("./faults.js"))[name] : () => ({}) };
};

panel({ place: "devices", order: 90, title: "Takeovers", needs, load: () => faults("takeovers") });
panel({ place: "device", order: 60, title: "Faults", needs, load: () => faults("buttons") });
