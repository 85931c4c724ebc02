// Panels of faults: where operators may let devices fail, the page has two panels for it; elsewhere nothing of them is loaded.
import { get } from "./link.js";
import { panel } from "./panel.js";

const needs = { role: "operator" };
let known;

// The node says what can fail; one that causes no faults says nothing.
const faults = async (name) => {
  known ??= get("faults").catch(() => ({ kinds: [] }));
  const { kinds } = await known;
  return { make: kinds.length ? (await import("./faults.js"))[name] : () => ({}) };
};

panel({ place: "devices", order: 90, title: "Takeovers", needs, load: () => faults("takeovers") });
panel({ place: "device", order: 60, title: "Faults", needs, load: () => faults("buttons") });
