// The records that a device stores, queried when its dialog is opened.
import { createElement } from "./element.js";
import { get } from "./connection.js";
import { formatNumber, text } from "./texts.js";

const formatSize = (bytes) => (bytes < 10000 ? `${formatNumber(bytes)} B` : bytes < 2 ** 20 ? `${formatNumber(bytes / 1024, 0)} KiB` : `${formatNumber(bytes / 2 ** 20, 1)} MiB`);

export function make(root) {
  const line = createElement("p", { class: "note", role: "status" });
  const kinds = createElement("ul", { class: "plain" });
  const newest = createElement("table");
  const again = createElement("button", {}, text("action.refresh"));
  let open = "";
  root.append(createElement("h3", {}, text("records.title")), line, kinds, createElement("div", { class: "wide", tabindex: 0, role: "region", "aria-label": text("records.newest_label") }, newest), again);

  async function query() {
    const asked = open;
    line.textContent = text("device.querying");
    kinds.replaceChildren();
    newest.replaceChildren();
    try {
      const told = await get(`devices/${asked}/inventory`);
      if (asked !== open) return;
      line.textContent = text(told.deleted ? "records.summary_deleted" : "records.summary", {
        count: told.records, size: formatSize(told.bytes), most: formatSize(told.most_bytes), deleted: told.deleted,
      });
      kinds.replaceChildren(...Object.entries(told.kinds).map(([kind, count]) => createElement("li", {}, text("records.kind", { count, kind }))));
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
