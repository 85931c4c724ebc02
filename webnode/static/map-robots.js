// Robots of the simulator: move one by finger, mouse or arrow keys; a tap or Enter turns it.
import { byId, setAttribute, createSvg } from "./element.js";
import { formatPosition } from "./format-position.js";
import { sendRequest } from "./request.js";
import { text } from "./texts.js";

const STEP = 0.05;
const TURN = Math.PI / 4;
const MARGIN = 0.12;
const NEAR = 0.03;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export function make(root, { model }) {
  const map = byId("map");
  const ghost = createSvg("circle", { class: "ghost", r: 14 });
  const hint = document.createElement("p");
  let dragged = null;
  hint.className = "hint";
  hint.textContent = text("robot.hint");
  root.append(hint);
  byId("target-position")?.after(root);

  const robot = (name) => model.yard?.dogs.find((dog) => dog.name === name);
  const shapeOf = (event) => event.target.closest?.("#map .dog");

  function positionOf(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(map.getScreenCTM().inverse());
    return clampPosition(point.x / 100, model.yard.walls[1] - point.y / 100);
  }

  function clampPosition(x, y) {
    const within = (value, side) => Math.round(Math.min(Math.max(value, MARGIN), side - MARGIN) * 1000) / 1000;
    return { x: within(x, model.yard.walls[0]), y: within(y, model.yard.walls[1]) };
  }

  function turn({ name, x, y, heading }) {
    const turned = heading + TURN > Math.PI ? heading + TURN - 2 * Math.PI : heading + TURN;
    return put(name, { x, y, heading: turned });
  }

  function put(name, place) {
    const done = (spot) => text("robot.moved", { name, position: formatPosition({ x: spot.x, y: spot.y }) });
    return sendRequest(text("robot.moving", { name }), `yard/robots/${encodeURIComponent(name)}`, { method: "PUT", body: place, done });
  }

  function show(spot) {
    if (!spot) return ghost.remove();
    setAttribute(ghost, "cx", spot.x * 100);
    setAttribute(ghost, "cy", (model.yard.walls[1] - spot.y) * 100);
    map.append(ghost);
  }

  function down(event) {
    const shape = shapeOf(event);
    if (!shape || !model.yard) return;
    shape.setPointerCapture(event.pointerId);
    dragged = { name: shape.dataset.key, from: positionOf(event), spot: null };
  }

  function move(event) {
    if (!dragged || !model.yard) return;
    const spot = positionOf(event);
    if (dragged.spot || Math.hypot(spot.x - dragged.from.x, spot.y - dragged.from.y) > NEAR) show(dragged.spot = spot);
  }

  function up(event) {
    const dog = robot(dragged?.name);
    if (dog && event.type === "pointerup") dragged.spot ? put(dog.name, dragged.spot) : turn(dog);
    dragged = null;
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
    await (arrow ? put(dog.name, clampPosition(dog.x + arrow[0] * STEP, dog.y + arrow[1] * STEP)) : turn(dog));
    sending = false;
  }

  const listeners = [["pointerdown", down], ["pointermove", move], ["pointerup", up], ["pointercancel", up], ["click", click], ["keydown", key]];
  for (const [name, act] of listeners) map.addEventListener(name, act, true);
  map.addEventListener("touchstart", touch, { passive: false });

  return {
    update(_, event) {
      if (event !== "yard" && event !== "") return;
      for (const shape of map.querySelectorAll(".dog")) {
        if (shape.querySelector(".grip")) continue;
        shape.append(createSvg("circle", { class: "grip", r: 18 }));
        for (const [name, value] of [["tabindex", 0], ["role", "button"]]) setAttribute(shape, name, value);
        setAttribute(shape, "aria-label", text("robot.label", { name: shape.dataset.key }));
      }
    },
    close() {
      for (const [name, act] of listeners) map.removeEventListener(name, act, true);
      map.removeEventListener("touchstart", touch);
      ghost.remove();
      for (const shape of map.querySelectorAll(".dog")) {
        shape.querySelector(".grip")?.remove();
        for (const name of ["tabindex", "role", "aria-label"]) shape.removeAttribute(name);
      }
    },
  };
}
