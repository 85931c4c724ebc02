// The records that a device stores, queried when its dialog is opened.
import { createElement } from "./element.js";
import { get } from "./connection.js";

const formatSize = (bytes) => (bytes < 10000 ? `${bytes} B` : bytes < 2 ** 20 ? `${Math.round(bytes / 1024)} KiB` : `${(bytes / 2 ** 20).toFixed(1)} MiB`);

export function make(root) {
  const line = createElement("p", { class: "note", role: "status" });
  const kinds = createElement("ul", { class: "plain" });
  const newest = createElement("table");
  const again = createElement("button", {}, "Refresh");
  let open = "";
  root.append(createElement("h3", {}, "Stores"), line, kinds, createElement("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Newest records" }, newest), again);

  async function query() {
    const asked = open;
    line.textContent = "Querying the device …";
    kinds.replaceChildren();
    newest.replaceChildren();
    try {
      const told = await get(`devices/${asked}/inventory`);
      if (asked !== open) return;
      line.textContent = `${told.records} records, ${formatSize(told.bytes)} of ${formatSize(told.most_bytes)}${told.deleted ? `; ${told.deleted} tombstones` : ""}.`;
      kinds.replaceChildren(...Object.entries(told.kinds).map(([kind, count]) => createElement("li", {}, `${count} of ${kind}`)));
      newest.replaceChildren(...told.newest.map(([kind, name, bytes, lifetime]) => createElement("tr", {},
        createElement("th", { scope: "row" }, name || "–"), createElement("td", {}, kind), createElement("td", {}, formatSize(bytes)), createElement("td", {}, lifetime))));
    } catch (error) {
      if (asked === open) line.textContent = error.message;
    }
  }

  again.addEventListener("click", query);
  return {
    show(uuid) {
      open = uuid;
      query();
    },
    hide() {
      open = "";
    },
  };
}
