// The map of the simulator, in centimetres with y upwards; the target follows a finger, a mouse or the arrow keys.
import { byId, setAttribute, createSvg, updateList, setText } from "./element.js";
import { formatPosition } from "./format-position.js";
import { sendRequest } from "./request.js";
import { registerPanel } from "./panel.js";
import { text } from "./texts.js";

const STEP = 0.05;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
let world = null;
let isDragged = false;
let settleAt = 0;
let sending = false;
let next = null;

const floor = createSvg("rect", { class: "floor", rx: 2 });
const grid = createSvg("path", { class: "grid" });
const dogs = createSvg("g");
const target = createSvg("g", { class: "target", role: "button", tabindex: 0 },
  createSvg("circle", { class: "reach", r: 22 }), createSvg("circle", { class: "ring", r: 13 }), createSvg("circle", { class: "ball", r: 8 }));

function showWorld(snapshot) {
  byId("place-map").hidden = !snapshot;
  if (snapshot && world && performance.now() < settleAt) snapshot = { ...snapshot, target: world.target };
  world = snapshot;
  if (!snapshot) return;
  const [w, h] = snapshot.walls.map((side) => side * 100);
  setAttribute(byId("map"), "viewBox", `-4 -4 ${w + 8} ${h + 8}`);
  setAttribute(floor, "width", w);
  setAttribute(floor, "height", h);
  let lines = "";
  for (let x = 50; x < w; x += 50) lines += `M${x} 0V${h}`;
  for (let y = h - 50; y > 0; y -= 50) lines += `M0 ${y}H${w}`;
  setAttribute(grid, "d", lines);
  updateList(dogs, snapshot.dogs, (dog) => dog.name, createRobot, (shape, dog) => {
    setAttribute(shape, "transform", `translate(${(dog.x * 100).toFixed(1)} ${(h - dog.y * 100).toFixed(1)})`);
    setAttribute(shape.firstChild, "transform", `rotate(${((-dog.heading * 180) / Math.PI).toFixed(1)})`);
  });
  placeTarget(snapshot.target);
}

// A robot from above, facing x, with as many yellow stripes on its head as its number.
function createRobot(dog) {
  const stripes = Array.from({ length: dog.stripes ?? 0 }, (_, n) => createSvg("rect", { class: "stripe", x: 5.2 + 2.7 * n, y: -4.6, width: 1.5, height: 9.2 }));
  return createSvg("g", { class: "dog" },
    createSvg("g", {},
      createSvg("path", { class: "gaze", d: "M15 0 40 -13 40 13z" }),
      createSvg("rect", { class: "body", x: -13, y: -7, width: 20, height: 14, rx: 5 }),
      createSvg("path", { class: "tail", d: "M-13 0h-5" }),
      createSvg("rect", { class: "head", x: 4, y: -5.5, width: 11, height: 11, rx: 3.5 }), ...stripes),
    createSvg("text", { y: 26 }, dog.name));
}

function placeTarget(spot) {
  target.classList.toggle("none", !spot);
  if (!spot) target.removeAttribute("tabindex");
  else setAttribute(target, "tabindex", 0);
  byId("remove-target").disabled = !spot;
  setText(byId("target-position"), spot ? text("target.at", { position: formatPosition(spot) }) : text("target.none"));
  if (!spot) return;
  setAttribute(target, "transform", `translate(${(spot.x * 100).toFixed(1)} ${((world.walls[1] - spot.y) * 100).toFixed(1)})`);
  setAttribute(target, "aria-label", text("target.label", { position: formatPosition(spot) }));
}

function positionOf(event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(byId("map").getScreenCTM().inverse());
  return clampPosition(point.x / 100, world.walls[1] - point.y / 100);
}

function clampPosition(x, y) {
  const within = (value, side) => Math.round(Math.min(Math.max(value, 0.1), side - 0.1) * 1000) / 1000;
  return { x: within(x, world.walls[0]), y: within(y, world.walls[1]) };
}

// One request in flight; of the waiting requests only the newest is kept, so the last position is set last.
async function send(doing) {
  next = doing;
  if (sending) return;
  sending = true;
  while (next) {
    const now = next;
    next = null;
    if (!(await now())) settleAt = 0;
  }
  sending = false;
}

// Show the new position immediately; earlier snapshots must not reset it while the request is in flight.
function moveTarget(spot) {
  settleAt = performance.now() + 700;
  world = { ...world, target: spot && { ...world.target, ...spot } };
  placeTarget(world.target);
  send(spot
    ? () => sendRequest(text("target.moving"), "target", { body: spot, done: () => text("target.moved", { position: formatPosition(spot) }) })
    : () => sendRequest(text("target.removing"), "target", { method: "DELETE", done: () => text("target.removed") }));
}

function startMap() {
  const map = byId("map");
  map.append(floor, grid, dogs, target);
  map.addEventListener("click", (event) => {
    if (world && !target.contains(event.target)) moveTarget(positionOf(event));
  });
  target.addEventListener("pointerdown", (event) => {
    target.setPointerCapture(event.pointerId);
    isDragged = true;
  });
  target.addEventListener("pointermove", (event) => {
    if (isDragged && world?.target) moveTarget(positionOf(event));
  });
  for (const name of ["pointerup", "pointercancel"]) target.addEventListener(name, () => { isDragged = false; });
  target.addEventListener("keydown", (event) => {
    const arrow = ARROWS[event.key];
    if (!arrow || !world?.target) return;
    event.preventDefault();
    moveTarget(clampPosition(world.target.x + arrow[0] * STEP, world.target.y + arrow[1] * STEP));
  });
  byId("set-target").addEventListener("click", () => { if (world) moveTarget(clampPosition(world.walls[0] / 2, world.walls[1] / 2)); });
  byId("remove-target").addEventListener("click", () => { if (world) moveTarget(null); });
}

registerPanel({
  place: "map",
  make() {
    startMap();
    return {
      update(model, event) {
        if (event === "yard" || !event) showWorld(model.yard);
      },
    };
  },
});
