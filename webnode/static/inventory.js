// The records that a device stores, queried when its dialog is opened.
import { element } from "./element.js";
import { get } from "./link.js";

const size = (bytes) => (bytes < 10000 ? `${bytes} B` : bytes < 2 ** 20 ? `${Math.round(bytes / 1024)} KiB` : `${(bytes / 2 ** 20).toFixed(1)} MiB`);

export function make(root) {
  const line = element("p", { class: "note", role: "status" });
  const kinds = element("ul", { class: "plain" });
  const newest = element("table");
  const again = element("button", {}, "Refresh");
  let open = "";
  root.append(element("h3", {}, "Stores"), line, kinds, element("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Newest records" }, newest), again);

  async function ask() {
    const asked = open;
    line.textContent = "Querying the device …";
    kinds.replaceChildren();
    newest.replaceChildren();
    try {
      const told = await get(`devices/${asked}/inventory`);
      if (asked !== open) return;
      line.textContent = `${told.records} records, ${size(told.bytes)} of ${size(told.most_bytes)}${told.deleted ? `; ${told.deleted} tombstones` : ""}.`;
      kinds.replaceChildren(...Object.entries(told.kinds).map(([kind, count]) => element("li", {}, `${count} of ${kind}`)));
      newest.replaceChildren(...told.newest.map(([kind, name, bytes, lifetime]) => element("tr", {},
        element("th", { scope: "row" }, name || "–"), element("td", {}, kind), element("td", {}, size(bytes)), element("td", {}, lifetime))));
    } catch (error) {
      if (asked === open) line.textContent = error.message;
    }
  }

  again.addEventListener("click", ask);
  return {
    show(uuid) {
      open = uuid;
      ask();
    },
    hide() {
      open = "";
    },
  };
}
