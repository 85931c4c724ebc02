// The network: the contacts of each device and their round-trip times, queried while the panel is in view.
import { byId, createSvg, createElement, updateList, setText } from "./element.js";
import { get } from "./connection.js";
import { pollWhileVisible } from "./polling.js";
import { formatNumber, text } from "./texts.js";

const EVERY = 2000;
const DRAWN = 12;
const SIDE = 300;

const formatMs = (value) => (value === null ? "–" : formatNumber(value, value < 10 ? 1 : 0));

// The devices that were queried, and further ones among their contacts.
function nodesOf({ devices, silent }, known) {
  const names = new Map(Object.keys(devices).map((uuid) => [uuid, known.get(uuid)?.name ?? uuid.slice(0, 8)]));
  for (const uuid of silent) names.set(uuid, known.get(uuid)?.name ?? uuid.slice(0, 8));
  for (const view of Object.values(devices)) for (const each of view.contacts) if (!names.has(each.uuid)) names.set(each.uuid, each.name);
  return [...names].slice(0, DRAWN).map(([uuid, name], place, all) => {
    const turn = (2 * Math.PI * place) / all.length - Math.PI / 2;
    return { uuid, name, x: SIDE / 2 + 105 * Math.cos(turn), y: SIDE / 2 + 105 * Math.sin(turn), silent: silent.includes(uuid) };
  });
}

function drawGraph(told, nodes) {
  const knows = (a, b) => told.devices[a.uuid]?.contacts.some((each) => each.uuid === b.uuid) ?? false;
  const pairs = nodes.flatMap((a, place) => nodes.slice(place + 1).map((b) => ({ a, b, ways: knows(a, b) + knows(b, a) })));
  const graph = byId("contact-graph");
  graph.replaceChildren(
    ...pairs.filter(({ ways }) => ways > 0).map(({ a, b, ways }) => createSvg("path", { class: "tie", "data-ways": ways, d: `M${a.x} ${a.y}L${b.x} ${b.y}` })),
    ...nodes.map(({ name, x, y, silent }) => createSvg("g", { class: "peer", "data-silent": silent, transform: `translate(${x} ${y})` },
      createSvg("circle", { r: 9 }), createSvg("text", { y: y < SIDE / 2 ? -16 : 26 }, silent ? text("network.silent_node", { name }) : name))));
}

function showTable(told, nodes) {
  const asked = nodes.filter(({ uuid }) => told.devices[uuid]);
  const head = createElement("tr", {}, createElement("td", {}), ...nodes.map(({ name }) => createElement("th", { scope: "col" }, name)));
  const rows = asked.map(({ uuid, name }) => createElement("tr", {}, createElement("th", { scope: "row" }, name), ...nodes.map((other) => {
    const tie = told.devices[uuid].contacts.find((each) => each.uuid === other.uuid);
    return createElement("td", {}, other.uuid === uuid ? "" : tie ? formatMs(tie.rtt_ms) : text("network.not_known"));
  })));
  byId("round-trips").replaceChildren(createElement("caption", {}, text("network.round_trips")), head, ...rows);
}

function show(told, known) {
  const nodes = nodesOf(told, known);
  drawGraph(told, nodes);
  showTable(told, nodes);
  updateList(byId("traffic"), Object.entries(told.devices), ([uuid]) => uuid, () => createElement("li", {}, createElement("b"), " ", createElement("span")),
    (item, [uuid, view]) => {
      setText(item.firstChild, known.get(uuid)?.name ?? uuid.slice(0, 8));
      const { known: count, sent, received, lost } = view;
      setText(item.lastChild, text(sent || received ? "network.traffic" : "network.no_traffic", { count, sent, received, lost }));
    });
  const lookups = Object.entries(told.devices).flatMap(([uuid, view]) => view.lookups.map((each) => ({ ...each, by: known.get(uuid)?.name ?? "" })));
  setText(byId("no-lookups"), text(lookups.length ? "network.lookups" : "network.no_lookups"));
  updateList(byId("lookups"), lookups.slice(0, 24), (each) => `${each.by} ${each.key} ${each.ms}`, () => createElement("li"),
    (item, each) => setText(item, text("network.lookup", {
      name: each.by, key: each.key.slice(0, 8), asked: each.asked, count: each.hops, found: each.found, time: formatMs(each.ms),
    })));
  const silent = told.silent.map((uuid) => known.get(uuid)?.name ?? uuid.slice(0, 8));
  setText(byId("network-line"), silent.length ? text("network.silent", { names: silent.join(", ") }) : text("network.all_answered"));
}

export function make(root, { model }) {
  root.append(
    createElement("p", { class: "hint", id: "network-line", role: "status" }),
    createSvg("svg", { id: "contact-graph", viewBox: `0 0 ${SIDE} ${SIDE}`, role: "img", "aria-label": text("network.graph_label") }),
    createElement("div", { class: "wide", tabindex: 0, role: "region", "aria-label": text("network.round_trips_label") }, createElement("table", { id: "round-trips" })),
    createElement("ul", { id: "traffic" }), createElement("h3", { id: "no-lookups" }, text("network.lookups")), createElement("ol", { id: "lookups", class: "plain" }));
  const close = pollWhileVisible(root, EVERY, async () => {
    try {
      show(await get("network"), model.devices);
    } catch (error) {
      setText(byId("network-line"), error.message);
    }
  });
  return { close };
}
