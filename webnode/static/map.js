// The map: the yard from above, in centimetres with y upwards; the target follows a finger, a mouse or the arrow keys.
import { at, attribute, drawn, keyed, words } from "./element.js";
import { ask, say, wish } from "./desk.js";

const STEP = 0.05;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
let yard = null;
let held = null;
let sentAt = 0;
let settleAt = 0;
let later;

const floor = drawn("rect", { class: "floor", rx: 2 });
const grid = drawn("path", { class: "grid" });
const dogs = drawn("g");
const target = drawn("g", { class: "target", role: "button", tabindex: 0 },
  drawn("circle", { class: "reach", r: 22 }), drawn("circle", { class: "ring", r: 13 }), drawn("circle", { class: "ball", r: 8 }));

export function showYard(snapshot) {
  at("yard").hidden = !snapshot;
  // A snapshot from before the last key must not pull the target back under the next one.
  if (snapshot?.target && yard?.target && performance.now() < settleAt) snapshot = { ...snapshot, target: yard.target };
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
  if (!held) placeTarget(snapshot.target);
}

// A dog seen from above, looking along x, with as many yellow stripes on the head as its number.
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
  words(at("place"), spot ? `Target at ${spot.x.toFixed(2)}, ${spot.y.toFixed(2)} m. Tap, drag or use the arrow keys.` : "No target. Tap the yard to place it.");
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

const move = (spot) => wish("Moving the target", "/api/target",
  { body: spot, done: () => `Target moved to ${spot.x.toFixed(2)}, ${spot.y.toFixed(2)} m.` });

export function startMap() {
  const map = at("map");
  map.append(floor, grid, dogs, target);
  map.addEventListener("click", (event) => {
    if (yard && !target.contains(event.target)) move(spotOf(event));
  });
  target.addEventListener("pointerdown", (event) => {
    target.setPointerCapture(event.pointerId);
    held = yard?.target ?? null;
  });
  target.addEventListener("pointermove", (event) => {
    if (!held) return;
    held = spotOf(event);
    placeTarget(held);
    if (performance.now() - sentAt < 200) return;
    sentAt = performance.now();
    ask("/api/target", held).catch((error) => say(error.message));
  });
  const drop = async () => {
    if (!held) return;
    await move({ x: held.x, y: held.y });
    held = null;
  };
  target.addEventListener("pointerup", drop);
  target.addEventListener("pointercancel", drop);
  target.addEventListener("keydown", (event) => {
    const arrow = ARROWS[event.key];
    if (!arrow || !yard?.target) return;
    event.preventDefault();
    const from = yard.target;
    const spot = inside(from.x + arrow[0] * STEP, from.y + arrow[1] * STEP);
    yard = { ...yard, target: { ...from, ...spot } };
    settleAt = performance.now() + 600;
    placeTarget(yard.target);
    clearTimeout(later);
    later = setTimeout(() => move(spot), 120);
  });
  at("put").addEventListener("click", () => { if (yard) move(inside(yard.walls[0] / 2, yard.walls[1] / 2)); });
  at("clear").addEventListener("click", () => wish("Taking the target away", "/api/target",
    { method: "DELETE", done: () => "The target is taken away." }));
}
