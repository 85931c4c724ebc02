// The map of the simulator, in centimetres with y upwards; the target follows a finger, a mouse or the arrow keys.
import { at, attribute, drawn, keyed, words } from "./element.js";
import { wish } from "./desk.js";
import { panel } from "./panel.js";

const STEP = 0.05;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
let yard = null;
let held = false;
let settleAt = 0;
let sending = false;
let next = null;

const floor = drawn("rect", { class: "floor", rx: 2 });
const grid = drawn("path", { class: "grid" });
const dogs = drawn("g");
const target = drawn("g", { class: "target", role: "button", tabindex: 0 },
  drawn("circle", { class: "reach", r: 22 }), drawn("circle", { class: "ring", r: 13 }), drawn("circle", { class: "ball", r: 8 }));

function showYard(snapshot) {
  at("place-map").hidden = !snapshot;
  if (snapshot && yard && performance.now() < settleAt) snapshot = { ...snapshot, target: yard.target };
  yard = snapshot;
  if (!snapshot) return;
  const [w, h] = snapshot.walls.map((side) => side * 100);
  attribute(at("map"), "viewBox", `-4 -4 ${w + 8} ${h + 8}`);
  attribute(floor, "width", w);
  attribute(floor, "height", h);
  let lines = "";
  for (let x = 50; x < w; x += 50) lines += `M${x} 0V${h}`;
  for (let y = h - 50; y > 0; y -= 50) lines += `M0 ${y}H${w}`;
  attribute(grid, "d", lines);
  keyed(dogs, snapshot.dogs, (dog) => dog.name, dogShape, (shape, dog) => {
    attribute(shape, "transform", `translate(${(dog.x * 100).toFixed(1)} ${(h - dog.y * 100).toFixed(1)})`);
    attribute(shape.firstChild, "transform", `rotate(${((-dog.heading * 180) / Math.PI).toFixed(1)})`);
  });
  placeTarget(snapshot.target);
}

// A robot from above, facing x, with as many yellow stripes on its head as its number.
function dogShape(dog) {
  const stripes = Array.from({ length: dog.stripes ?? 0 }, (_, n) => drawn("rect", { class: "stripe", x: 5.2 + 2.7 * n, y: -4.6, width: 1.5, height: 9.2 }));
  return drawn("g", { class: "dog" },
    drawn("g", {},
      drawn("path", { class: "gaze", d: "M15 0 40 -13 40 13z" }),
      drawn("rect", { class: "body", x: -13, y: -7, width: 20, height: 14, rx: 5 }),
      drawn("path", { class: "tail", d: "M-13 0h-5" }),
      drawn("rect", { class: "head", x: 4, y: -5.5, width: 11, height: 11, rx: 3.5 }), ...stripes),
    drawn("text", { y: 26 }, dog.name));
}

function placeTarget(spot) {
  target.classList.toggle("none", !spot);
  if (!spot) target.removeAttribute("tabindex");
  else attribute(target, "tabindex", 0);
  at("clear").disabled = !spot;
  words(at("place"), spot ? `Target at ${spot.x.toFixed(2)}, ${spot.y.toFixed(2)} m. Tap, drag or use the arrow keys.` : "No target. Tap the map to place it.");
  if (!spot) return;
  attribute(target, "transform", `translate(${(spot.x * 100).toFixed(1)} ${((yard.walls[1] - spot.y) * 100).toFixed(1)})`);
  attribute(target, "aria-label", `Target at ${spot.x.toFixed(1)}, ${spot.y.toFixed(1)} metres; arrow keys move it`);
}

function spotOf(event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(at("map").getScreenCTM().inverse());
  return inside(point.x / 100, yard.walls[1] - point.y / 100);
}

function inside(x, y) {
  const within = (value, side) => Math.round(Math.min(Math.max(value, 0.1), side - 0.1) * 1000) / 1000;
  return { x: within(x, yard.walls[0]), y: within(y, yard.walls[1]) };
}

// One request in flight; of the waiting ones only the newest is kept, so the last one is carried out last.
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

// Show the new position at once; earlier snapshots must not reset it while the request is in flight.
function want(spot) {
  settleAt = performance.now() + 700;
  yard = { ...yard, target: spot && { ...yard.target, ...spot } };
  placeTarget(yard.target);
  send(spot
    ? () => wish("Moving the target", "target", { body: spot, done: () => `Target moved to ${spot.x.toFixed(2)}, ${spot.y.toFixed(2)} m.` })
    : () => wish("Removing the target", "target", { method: "DELETE", done: () => "Target removed." }));
}

function startMap() {
  const map = at("map");
  map.append(floor, grid, dogs, target);
  map.addEventListener("click", (event) => {
    if (yard && !target.contains(event.target)) want(spotOf(event));
  });
  target.addEventListener("pointerdown", (event) => {
    target.setPointerCapture(event.pointerId);
    held = true;
  });
  target.addEventListener("pointermove", (event) => {
    if (held && yard?.target) want(spotOf(event));
  });
  for (const name of ["pointerup", "pointercancel"]) target.addEventListener(name, () => { held = false; });
  target.addEventListener("keydown", (event) => {
    const arrow = ARROWS[event.key];
    if (!arrow || !yard?.target) return;
    event.preventDefault();
    want(inside(yard.target.x + arrow[0] * STEP, yard.target.y + arrow[1] * STEP));
  });
  at("put").addEventListener("click", () => { if (yard) want(inside(yard.walls[0] / 2, yard.walls[1] / 2)); });
  at("clear").addEventListener("click", () => { if (yard) want(null); });
}

panel({
  place: "map",
  title: "Simulator",
  make() {
    startMap();
    return {
      update(model, event) {
        if (event === "yard" || !event) showYard(model.yard);
      },
    };
  },
});
