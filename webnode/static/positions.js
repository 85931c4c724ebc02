// Positions: without a simulator, a map of the devices that report their positions, scaled to fit them.
import { byId, setAttribute, createSvg, createElement, updateList, setText } from "./element.js";
import { registerPanel } from "./panel.js";
import { go } from "./shell.js";
import { formatPosition } from "./format-position.js";
import { formatNumber, text } from "./texts.js";

const LEAST = 2;
const MARGIN = 36;
const FOOT = 24;
const PAUSE = 1000;
const NAMED = 40;
const METRES = 111_320;
const isMetres = ({ position }) => "x" in position;

// Coordinates in metres for devices that share a frame: the local frame, or east and north of the first device on the
// globe.  The map shows the frame that more devices use.  A degree of longitude shrinks towards the poles.
function projectPositions(placed) {
  const local = placed.filter(isMetres);
  if (2 * local.length >= placed.length) return local.map((device) => ({ device, ...device.position }));
  const drawn = placed.filter((device) => !isMetres(device));
  const [first] = drawn;
  const shrink = Math.cos((first.position.lat * Math.PI) / 180);
  return drawn.map((device) => {
    const { lat, lon, accuracy } = device.position;
    const east = ((lon - first.position.lon + 540) % 360) - 180;
    return { device, x: east * METRES * shrink, y: (lat - first.position.lat) * METRES, accuracy };
  });
}

// The largest of 1, 2 or 5 times a power of ten that is not longer than `metres`.
function roundDown(metres) {
  const power = 10 ** Math.floor(Math.log10(metres));
  return [5, 2, 1].find((n) => n * power <= metres) * power;
}

const formatLength = (metres) => (metres >= 1000 ? `${formatNumber(metres / 1000)} km` : metres >= 1 ? `${formatNumber(metres)} m` : `${formatNumber(metres * 100, 0)} cm`);

function createMarker({ uuid }) {
  const show = (event) => {
    if (event.type === "keydown" && event.key !== "Enter") return;
    go(`device/${uuid}`);
  };
  const made = createSvg("g", { class: "spot", role: "button", tabindex: 0 },
    createSvg("circle", { class: "blur" }), createSvg("circle", { class: "reach", r: 22 }), createSvg("path", { class: "way", d: "M9 -7 22 0 9 7z" }),
    createSvg("circle", { class: "dot", r: 8 }), createSvg("text", { y: 24 }));
  made.addEventListener("click", show);
  made.addEventListener("keydown", show);
  return made;
}

document.head.append(createElement("link", { rel: "stylesheet", href: "/static/positions.css" }));

registerPanel({
  place: "map",
  order: 5,
  make(root) {
    const map = createSvg("svg", { id: "position-map", role: "group", "aria-label": text("map.positions_label") });
    const bar = createSvg("g", { class: "scale" }, createSvg("path"), createSvg("text", { y: -8 }));
    const spots = createSvg("g");
    const list = createElement("ul", { class: "plain places" });
    const hint = createElement("p", { class: "hint" });
    map.append(createSvg("rect", { class: "floor", rx: 6 }), bar, spots);
    root.append(map, hint, list);
    let placed = [];
    let known = "";
    let due = 0;
    // Drawn in pixels, so that the text has its usual size: redrawn when the width changes.
    const size = new ResizeObserver(() => refresh());
    size.observe(root);

    function refresh() {
      const now = JSON.stringify([root.clientWidth, ...placed.map(({ uuid, name, status, position }) => [uuid, name, status, position])]);
      if (!placed.length || !root.clientWidth || now === known || due) return;
      known = now;
      draw();
      // A large map is redrawn at most once a second, so it does not delay the user's typing.
      if (placed.length > NAMED) due = setTimeout(() => { due = 0; refresh(); }, PAUSE);
    }

    function draw() {
      const found = projectPositions(placed);
      const width = root.clientWidth;
      const range = (key, room) => {
        const seen = found.map((each) => [each[key], Math.min(each.accuracy ?? 0, room)]);
        return [Math.min(...seen.map(([at, blur]) => at - blur)), Math.max(...seen.map(([at, blur]) => at + blur))];
      };
      // One inaccurate position must not shrink all others to a dot.
      const room = Math.max(LEAST, ...["x", "y"].map((key) => range(key, 0)).map(([from, to]) => to - from));
      const [west, east] = range("x", room);
      const [south, north] = range("y", room);
      // As high as needed, but not higher than wide.
      const scale = Math.min((width - 2 * MARGIN) / Math.max(east - west, LEAST), (width - 2 * MARGIN) / Math.max(north - south, LEAST));
      const height = Math.max((north - south) * scale, 120) + 2 * MARGIN + FOOT;
      const place = ({ x, y }) => [width / 2 + (x - (west + east) / 2) * scale, (height - FOOT) / 2 - (y - (south + north) / 2) * scale];
      setAttribute(map, "viewBox", `0 0 ${width} ${height.toFixed(0)}`);
      setAttribute(map.firstChild, "width", width);
      setAttribute(map.firstChild, "height", height.toFixed(0));
      updateList(spots, found, ({ device }) => device.uuid, ({ device }) => createMarker(device), (spot, each) => {
        const { device, heading, accuracy } = each;
        setAttribute(spot, "transform", `translate(${place(each).map((n) => n.toFixed(1)).join(" ")})`);
        setAttribute(spot, "data-state", device.status);
        setAttribute(spot, "aria-label", text("position.device", { name: device.name, position: formatPosition(device.position) }));
        setAttribute(spot.querySelector(".blur"), "r", Math.min((accuracy ?? 0) * scale, width).toFixed(1));
        const way = spot.querySelector(".way");
        setAttribute(way, "display", Number.isFinite(heading) ? "inline" : "none");
        if (Number.isFinite(heading)) setAttribute(way, "transform", `rotate(${((-heading * 180) / Math.PI).toFixed(1)})`);
        setText(spot.lastChild, found.length > NAMED ? "" : device.name);
      });
      const metres = roundDown((width / 3) / scale);
      setAttribute(bar, "transform", `translate(14 ${(height - 12).toFixed(0)})`);
      setAttribute(bar.firstChild, "d", `M0 -5V0H${(metres * scale).toFixed(1)}V-5`);
      setText(bar.lastChild, formatLength(metres));
      const isLocal = isMetres(found[0].device);
      const others = placed.length - found.length;
      setText(hint, [text(isLocal ? "map.local_frame" : "map.globe_frame"), ...(others ? [text("map.other_frame", { count: others })] : [])].join(" "));
      updateList(list, placed.slice(0, NAMED), (device) => device.uuid, () => createElement("li", {}, createElement("b"), " ", createElement("span")), (item, device) => {
        setText(item.firstChild, device.name);
        setText(item.lastChild, formatPosition(device.position));
      });
    }

    return {
      update(model, event) {
        if (event !== "state" && event !== "yard" && event !== "") return;
        placed = model.yard ? [] : [...model.devices.values()].filter((device) => device.position);
        const section = byId("place-map");
        section.classList.toggle("reported", !model.yard);
        root.hidden = !placed.length;
        for (const node of [byId("h-map"), document.querySelector("#views [href='#map']")]) setText(node, text(model.yard ? "map.simulator" : "map.title"));
        if (!model.yard) section.hidden = !placed.length;
        refresh();
      },
      close() {
        clearTimeout(due);
        size.disconnect();
      },
    };
  },
});
