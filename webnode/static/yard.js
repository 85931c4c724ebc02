// Robots of the simulator: move one by finger, mouse or arrow keys; a tap or Enter turns it.
import { at, attribute, drawn } from "./element.js";
import { wish } from "./desk.js";

const STEP = 0.05;
const TURN = Math.PI / 4;
const MARGIN = 0.12;
const NEAR = 0.03;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export function make(root, { model }) {
  const map = at("map");
  const ghost = drawn("circle", { class: "ghost", r: 14 });
  const hint = document.createElement("p");
  let lifted = null;
  hint.className = "hint";
  hint.textContent = "Drag a robot to move it, tap it to turn it; or select it and use the arrow keys and Enter.";
  root.append(hint);
  at("place")?.after(root);

  const robot = (name) => model.yard?.dogs.find((dog) => dog.name === name);
  const shapeOf = (event) => event.target.closest?.("#map .dog");

  function spotOf(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(map.getScreenCTM().inverse());
    return inside(point.x / 100, model.yard.walls[1] - point.y / 100);
  }

  function inside(x, y) {
    const within = (value, side) => Math.round(Math.min(Math.max(value, MARGIN), side - MARGIN) * 1000) / 1000;
    return { x: within(x, model.yard.walls[0]), y: within(y, model.yard.walls[1]) };
  }

  function turn({ name, x, y, heading }) {
    const turned = heading + TURN > Math.PI ? heading + TURN - 2 * Math.PI : heading + TURN;
    return put(name, { x, y, heading: turned });
  }

  function put(name, place) {
    const done = ({ x, y }) => `${name} moved to ${x.toFixed(2)}, ${y.toFixed(2)} m.`;
    return wish(`Moving ${name}`, `yard/robots/${encodeURIComponent(name)}`, { method: "PUT", body: place, done });
  }

  function show(spot) {
    if (!spot) return ghost.remove();
    attribute(ghost, "cx", spot.x * 100);
    attribute(ghost, "cy", (model.yard.walls[1] - spot.y) * 100);
    map.append(ghost);
  }

  function down(event) {
    const shape = shapeOf(event);
    if (!shape || !model.yard) return;
    shape.setPointerCapture(event.pointerId);
    lifted = { name: shape.dataset.key, from: spotOf(event), spot: null };
  }

  function move(event) {
    if (!lifted || !model.yard) return;
    const spot = spotOf(event);
    if (lifted.spot || Math.hypot(spot.x - lifted.from.x, spot.y - lifted.from.y) > NEAR) show(lifted.spot = spot);
  }

  function up(event) {
    const dog = robot(lifted?.name);
    if (dog && event.type === "pointerup") lifted.spot ? put(dog.name, lifted.spot) : turn(dog);
    lifted = null;
    show(null);
  }

  // A tap on a robot must not also place the target.
  function click(event) {
    if (shapeOf(event)) event.stopPropagation();
  }

  // Dragging must not scroll the page; inside an SVG the CSS property is not enough.
  function touch(event) {
    if (event.target.closest?.("#map .dog, #map .target")) event.preventDefault();
  }

  let sending = false;
  async function key(event) {
    const dog = robot(shapeOf(event)?.dataset.key);
    const arrow = ARROWS[event.key];
    if (!dog || !(arrow || event.key === "Enter")) return;
    event.preventDefault();
    if (sending) return;
    sending = true;
    await (arrow ? put(dog.name, inside(dog.x + arrow[0] * STEP, dog.y + arrow[1] * STEP)) : turn(dog));
    sending = false;
  }

  const heard = [["pointerdown", down], ["pointermove", move], ["pointerup", up], ["pointercancel", up], ["click", click], ["keydown", key]];
  for (const [name, act] of heard) map.addEventListener(name, act, true);
  map.addEventListener("touchstart", touch, { passive: false });

  return {
    update(_, event) {
      if (event !== "yard" && event !== "") return;
      for (const shape of map.querySelectorAll(".dog")) {
        if (shape.querySelector(".grip")) continue;
        shape.append(drawn("circle", { class: "grip", r: 18 }));
        for (const [name, value] of [["tabindex", 0], ["role", "button"]]) attribute(shape, name, value);
        attribute(shape, "aria-label", `${shape.dataset.key}; arrow keys move it, Enter turns it`);
      }
    },
    close() {
      for (const [name, act] of heard) map.removeEventListener(name, act, true);
      map.removeEventListener("touchstart", touch);
      ghost.remove();
      for (const shape of map.querySelectorAll(".dog")) {
        shape.querySelector(".grip")?.remove();
        for (const name of ["tabindex", "role", "aria-label"]) shape.removeAttribute(name);
      }
    },
  };
}
