// Links: path and quality from the serving node to each device, and between the others; rejected nodes.
import { byId, setAttribute, createSvg, createElement, updateList, joinNames, formatDuration, setText } from "./element.js";
import { get } from "./connection.js";
import { pollWhileVisible } from "./polling.js";
import { formatNumber, text, textOf } from "./texts.js";

const EVERY = 2500;
const SHOWN = 40;
const BARS = { well: 4, fair: 3, poor: 2, silent: 0, measuring: 0 };

const gradeOf = (score) => (score === null ? "measuring" : score >= 80 ? "well" : score >= 50 ? "fair" : score > 0 ? "poor" : "silent");
const formatMs = (value) => formatNumber(value, value < 10 ? 1 : 0);
const rankOf = ({ score }) => score ?? 101;

function describePath(link) {
  const path = link.way === "carried" ? text("path.relayed", { name: link.by || text("path.no_relay") }) : textOf("path.kind", link.way);
  return link.for_s === null ? path : text("path.since", { path, time: formatDuration(link.for_s) });
}

function describeQuality({ loss, rtt_ms: trip, jitter_ms: jitter }) {
  if (loss === null) return "";
  return trip === null ? text("quality.silent") : text("path.figures", { trip: formatMs(trip), jitter: formatMs(jitter), percent: Math.round(100 * loss) });
}

function createRow() {
  const bars = createSvg("svg", { viewBox: "0 0 16 14", "aria-hidden": "true" },
    ...[0, 1, 2, 3].map((n) => createSvg("rect", { x: 4 * n, y: 10 - 3 * n, width: 3, height: 4 + 3 * n })));
  return createElement("li", { class: "tie-row" }, createElement("b"), createElement("span", { class: "score" }, bars, createElement("span")),
    createElement("span", { class: "by" }), createElement("span", { class: "figures" }));
}

function updateRow(item, { label, link }) {
  const [name, score, way, told] = item.children;
  const found = gradeOf(link.score);
  setText(name, label);
  setAttribute(score, "data-grade", found);
  [...score.firstChild.children].forEach((bar, n) => setAttribute(bar, "data-lit", n < BARS[found]));
  setText(score.lastChild, link.score === null || !link.score ? text(`quality.${found}`) : `${formatNumber(link.score)} – ${text(`quality.${found}`)}`);
  setText(way, describePath(link));
  setText(told, describeQuality(link));
}

// The worse direction of each pair, worst pair first.
function pairLinks(told, name) {
  const found = new Map();
  for (const [uuid, view] of Object.entries(told.devices)) {
    if (uuid === told.here) continue;
    for (const link of view.links) {
      const key = [uuid, link.uuid].sort().join(" ");
      if (link.uuid === told.here || (found.has(key) && rankOf(found.get(key).link) <= rankOf(link))) continue;
      found.set(key, { key, label: `${name(uuid)} – ${link.name}`, link });
    }
  }
  return [...found.values()].sort((a, b) => rankOf(a.link) - rankOf(b.link) || (a.key < b.key ? -1 : 1));
}

// One line for each rejected node, combined from the reports of all devices.
function mergeRefusals(told, name) {
  const found = new Map();
  for (const [uuid, view] of Object.entries(told.devices)) {
    for (const each of view.refusals) {
      const other = each.who || each.at;
      const [who, by] = each.side === "they" ? [name(uuid), other] : [each.side === "code" ? text("refusal.newcomer", { address: each.at }) : other, name(uuid)];
      const key = `${who} ${each.code} ${each.side === "call"}`;
      const known = found.get(key) ?? { ...each, key, who, by: [], count: 0 };
      found.set(key, { ...known, by: [...new Set([...known.by, by])], count: known.count + each.count, ago_s: Math.min(known.ago_s, each.ago_s) });
    }
  }
  return [...found.values()].sort((a, b) => a.ago_s - b.ago_s);
}

function updateRefusal(item, each) {
  const [who, why, remedy] = item.children;
  const what = text(each.side === "call" ? "refusal.call" : "refusal.rejected", { names: joinNames(each.by, 3) });
  setText(who.firstChild, each.who);
  setText(who.lastChild, ` ${what}; ${text(each.count > 1 ? "refusal.ago_times" : "refusal.ago", { time: formatDuration(each.ago_s), count: each.count })}`);
  const isJoin = each.side === "code";
  setText(why, `${each.code}: ${textOf(isJoin ? "refusal.join_why" : "refusal.member_why", each.code, each.why)}`);
  const advice = textOf(isJoin ? "refusal.join_remedy" : "refusal.member_remedy", each.code, each.remedy);
  setText(remedy, advice ? text("refusal.remedy", { remedy: advice }) : "");
}

function summarize(told, own, others) {
  const graded = (least, most) => [...own, ...others].filter(({ link }) => link.score !== null && link.score >= least && link.score < most).length;
  const [poor, fair] = [graded(0, 50), graded(50, 80)];
  const silent = told.silent.length ? ` ${text("path.silent", { count: told.silent.length })}` : "";
  const grades = [poor && text("path.poor", { count: poor }), fair && text("path.fair", { count: fair })].filter(Boolean).join(", ");
  const state = own.some(({ link }) => link.score === null) ? text("quality.measuring") : grades || text("path.all_well");
  return text("path.summary", { count: own.length + others.length, state }) + silent;
}

function show(told, model) {
  const name = (uuid) => model.devices.get(uuid)?.name ?? (uuid === told.here ? model.node : uuid.slice(0, 8));
  const own = (told.devices[told.here]?.links ?? []).map((link) => ({ key: link.uuid, label: link.name, link })).sort((a, b) => (a.label < b.label ? -1 : 1));
  const others = pairLinks(told, name);
  const turned = mergeRefusals(told, name);
  setText(byId("paths-line"), summarize(told, own, others));
  setText(byId("paths-from"), text("path.of_node", { name: name(told.here) }));
  updateList(byId("paths"), own, ({ key }) => key, createRow, updateRow);
  byId("paths-others").hidden = others.length === 0;
  setText(byId("paths-others").firstChild, text("path.between", { count: others.length }));
  updateList(byId("paths-between"), others.slice(0, SHOWN), ({ key }) => key, createRow, updateRow);
  setText(byId("refusals-line"), text(turned.length ? "refusal.title" : "refusal.none"));
  updateList(byId("refusals"), turned, ({ key }) => key,
    () => createElement("li", {}, createElement("span", {}, createElement("b"), createElement("span")), createElement("span", { class: "why" }), createElement("span", { class: "remedy" })), updateRefusal);
}

if (!document.querySelector("link[href='/static/paths.css']")) document.head.append(createElement("link", { rel: "stylesheet", href: "/static/paths.css" }));

export function make(root, { model }) {
  root.append(
    createElement("h3", {}, text("path.title")), createElement("p", { class: "hint", id: "paths-line", role: "status" }, text("path.querying")),
    createElement("p", { class: "hint", id: "paths-from" }), createElement("ul", { id: "paths" }),
    createElement("details", { id: "paths-others", hidden: "" }, createElement("summary"), createElement("ul", { id: "paths-between" })),
    createElement("p", { class: "hint", id: "refusals-line" }), createElement("ul", { id: "refusals" }));
  const close = pollWhileVisible(root, EVERY, async () => {
    try {
      show(await get("links"), model);
    } catch (error) {
      setText(byId("paths-line"), error.message);
    }
  });
  return { close };
}
