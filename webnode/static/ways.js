// Links: path and quality from the serving node to each device, and between the others; rejected nodes.
import { at, attribute, drawn, element, keyed, several, span, words } from "./element.js";
import { get } from "./link.js";
import { watch } from "./watch.js";

const EVERY = 2500;
const SHOWN = 40;
const WAYS = { none: "no path yet", machine: "on one machine", lan: "LAN", direct: "direct", punched: "hole punched", tunnel: "tunnel over TLS" };
const GRADES = { well: "well", fair: "fair", poor: "poor", silent: "no answer", measuring: "measuring" };
const BARS = { well: 4, fair: 3, poor: 2, silent: 0, measuring: 0 };

const grade = (score) => (score === null ? "measuring" : score >= 80 ? "well" : score >= 50 ? "fair" : score > 0 ? "poor" : "silent");
const ms = (value) => (value < 10 ? value.toFixed(1) : String(Math.round(value)));
const pace = ({ score }) => score ?? 101;

function named(link) {
  const way = link.way === "carried" ? `relayed by ${link.by || "no node now"}` : WAYS[link.way];
  return link.for_s === null ? way : `${way}, for ${span(link.for_s)}`;
}

function figures({ loss, rtt_ms: trip, jitter_ms: jitter }) {
  if (loss === null) return "";
  return trip === null ? "no answer" : `${ms(trip)} ms, jitter ${ms(jitter)} ms, ${Math.round(100 * loss)} % lost`;
}

function row() {
  const bars = drawn("svg", { viewBox: "0 0 16 14", "aria-hidden": "true" },
    ...[0, 1, 2, 3].map((n) => drawn("rect", { x: 4 * n, y: 10 - 3 * n, width: 3, height: 4 + 3 * n })));
  return element("li", { class: "tie-row" }, element("b"), element("span", { class: "score" }, bars, element("span")),
    element("span", { class: "by" }), element("span", { class: "figures" }));
}

function fill(item, { label, link }) {
  const [name, score, way, told] = item.children;
  const found = grade(link.score);
  words(name, label);
  attribute(score, "data-grade", found);
  [...score.firstChild.children].forEach((bar, n) => attribute(bar, "data-lit", n < BARS[found]));
  words(score.lastChild, link.score === null || !link.score ? GRADES[found] : `${link.score} – ${GRADES[found]}`);
  words(way, named(link));
  words(told, figures(link));
}

// The worse direction of each pair, worst pair first.
function pairs(told, name) {
  const found = new Map();
  for (const [uuid, view] of Object.entries(told.devices)) {
    if (uuid === told.here) continue;
    for (const link of view.links) {
      const key = [uuid, link.uuid].sort().join(" ");
      if (link.uuid === told.here || (found.has(key) && pace(found.get(key).link) <= pace(link))) continue;
      found.set(key, { key, label: `${name(uuid)} – ${link.name}`, link });
    }
  }
  return [...found.values()].sort((a, b) => pace(a.link) - pace(b.link) || (a.key < b.key ? -1 : 1));
}

// One line for each rejected node, combined from the reports of all devices.
function refusals(told, name) {
  const found = new Map();
  for (const [uuid, view] of Object.entries(told.devices)) {
    for (const each of view.refusals) {
      const other = each.who || each.at;
      const [who, by] = each.side === "they" ? [name(uuid), other] : [each.side === "code" ? `a newcomer at ${each.at}` : other, name(uuid)];
      const key = `${who} ${each.code} ${each.side === "call"}`;
      const known = found.get(key) ?? { ...each, key, who, by: [], count: 0 };
      found.set(key, { ...known, by: [...new Set([...known.by, by])], count: known.count + each.count, ago_s: Math.min(known.ago_s, each.ago_s) });
    }
  }
  return [...found.values()].sort((a, b) => a.ago_s - b.ago_s);
}

function refused(item, each) {
  const [who, why, remedy] = item.children;
  const times = each.count > 1 ? `, ${each.count} times` : "";
  const what = each.side === "call" ? `is not authorized for a request to ${several(each.by, 3)}` : `is rejected by ${several(each.by, 3)}`;
  words(who.firstChild, each.who);
  words(who.lastChild, ` ${what}; ${span(each.ago_s)} ago${times}`);
  words(why, `${each.code}: ${each.why}`);
  words(remedy, each.remedy ? `Remedy: ${each.remedy}` : "");
}

function summary(told, own, others) {
  const graded = (least, most) => [...own, ...others].filter(({ link }) => link.score !== null && link.score >= least && link.score < most).length;
  const [poor, fair] = [graded(0, 50), graded(50, 80)];
  const silent = told.silent.length ? ` ${told.silent.length} did not answer.` : "";
  const state = own.some(({ link }) => link.score === null) ? "measuring" : [poor && `${poor} poor`, fair && `${fair} fair`].filter(Boolean).join(", ") || "all well";
  return `${own.length + others.length} links: ${state}.${silent}`;
}

function show(told, model) {
  const name = (uuid) => model.devices.get(uuid)?.name ?? (uuid === told.here ? model.node : uuid.slice(0, 8));
  const own = (told.devices[told.here]?.links ?? []).map((link) => ({ key: link.uuid, label: link.name, link })).sort((a, b) => (a.label < b.label ? -1 : 1));
  const others = pairs(told, name);
  const turned = refusals(told, name);
  words(at("ways-line"), summary(told, own, others));
  words(at("ways-from"), `Links of ${name(told.here)}, score 0 to 100`);
  keyed(at("ways"), own, ({ key }) => key, row, fill);
  at("ways-others").hidden = others.length === 0;
  words(at("ways-others").firstChild, `Between the others: ${others.length}, worst first`);
  keyed(at("ways-between"), others.slice(0, SHOWN), ({ key }) => key, row, fill);
  words(at("ways-refused"), turned.length ? "Rejected nodes of the last hour" : "No node was rejected in the last hour.");
  keyed(at("refusals"), turned, ({ key }) => key,
    () => element("li", {}, element("span", {}, element("b"), element("span")), element("span", { class: "why" }), element("span", { class: "remedy" })), refused);
}

if (!document.querySelector("link[href='/static/ways.css']")) document.head.append(element("link", { rel: "stylesheet", href: "/static/ways.css" }));

export function make(root, { model }) {
  root.append(
    element("h3", {}, "Links"), element("p", { class: "hint", id: "ways-line", role: "status" }, "Querying the devices …"),
    element("p", { class: "hint", id: "ways-from" }), element("ul", { id: "ways" }),
    element("details", { id: "ways-others", hidden: "" }, element("summary"), element("ul", { id: "ways-between" })),
    element("p", { class: "hint", id: "ways-refused" }), element("ul", { id: "refusals" }));
  const close = watch(root, EVERY, async () => {
    try {
      show(await get("links"), model);
    } catch (error) {
      words(at("ways-line"), error.message);
    }
  });
  return { close };
}
