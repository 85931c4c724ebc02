// Cameras: one loop and one picture in flight per camera; a camera that is not in view fetches nothing.
import { at, attribute, element, keyed, words } from "./element.js";
import { frames } from "./link.js";
import { panel } from "./panel.js";

const cameras = new Map();
const figures = new WeakMap();
// One observer for all figures: which of them are in view.
const sight = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) figures.get(target)?.seen(isIntersecting);
});

class Camera {
  constructor(uuid) {
    this.uuid = uuid;
    this.seq = "";
    this.at = 0;
    this.visible = false;
    this.gone = false;
    this.closed = false;
    this.flight = null;
    this.moved = false;
    this.trouble = "";
    this.canvas = element("canvas", { width: 208, height: 160, role: "img" });
    this.name = element("b");
    this.told = element("span", { class: "age" });
    this.figure = element("figure", { "data-camera": "wait" }, this.canvas, element("figcaption", {}, this.name, this.told));
    figures.set(this.figure, this);
    sight.observe(this.figure);
  }

  seen(visible) {
    this.visible = visible;
    this.turn();
    this.tell();
  }

  get wanted() {
    return this.visible && !this.gone && !this.closed && !document.hidden;
  }

  // Start the loop if the camera is in view, else abort the request in flight.
  turn() {
    if (!this.wanted) this.flight?.abort();
    else if (!this.flight) this.loop();
  }

  async loop() {
    while (this.wanted) {
      this.flight = new AbortController();
      const deadline = setTimeout(() => this.flight?.abort(), 12000);
      try {
        const answer = await frames(this.uuid, this.seq, this.flight.signal);
        if (answer.status === 200) {
          const picture = await createImageBitmap(await answer.blob());
          this.seq = answer.headers.get("X-Seq");
          this.at = performance.now() - 1000 * Number(answer.headers.get("X-Age"));
          this.draw(picture);
          this.trouble = "";
        } else if (answer.status !== 204) {
          this.trouble = (await answer.json().catch(() => ({}))).error?.problem ?? "no picture";
          await pause();
        }
      } catch {
        if (this.wanted && !this.moved) await pause();
        this.moved = false;
      }
      clearTimeout(deadline);
    }
    this.flight = null;
  }

  // Request from the node that serves now; a pending answer of the last node is of no use.
  renew() {
    this.seq = "";
    this.moved = this.flight !== null;
    this.flight?.abort();
  }

  draw(picture) {
    if (this.canvas.width !== picture.width) Object.assign(this.canvas, { width: picture.width, height: picture.height });
    this.canvas.getContext("2d").drawImage(picture, 0, 0);
    picture.close();
  }

  tell() {
    const age = (performance.now() - this.at) / 1000;
    const state = this.gone ? "gone" : !this.at ? "wait" : age < 1 ? "live" : "late";
    const seen = this.at ? `${age < 10 ? age.toFixed(1) : Math.round(age)} s old` : "no picture yet";
    attribute(this.figure, "data-camera", state);
    words(this.told, this.gone ? `gone, ${seen}` : this.trouble && state !== "live" ? this.trouble : state === "live" ? `live, ${seen}` : seen);
  }

  close() {
    this.closed = true;
    sight.unobserve(this.figure);
    this.flight?.abort();
  }
}

const pause = () => new Promise((done) => setTimeout(done, 1000));

function showCameras(devices) {
  const seeing = devices.filter((device) => device.capabilities.camera);
  at("no-cameras").hidden = seeing.length > 0;
  for (const [uuid, camera] of cameras) {
    if (seeing.some((device) => device.uuid === uuid)) continue;
    camera.close();
    cameras.delete(uuid);
  }
  keyed(at("cameras"), seeing, (device) => device.uuid,
    (device) => {
      cameras.set(device.uuid, new Camera(device.uuid));
      return cameras.get(device.uuid).figure;
    },
    (figure, device) => {
      const camera = cameras.get(device.uuid);
      words(camera.name, device.name);
      attribute(camera.canvas, "aria-label", `Camera of ${device.name}`);
      camera.gone = device.gone !== null;
      camera.turn();
    });
}

panel({
  place: "cameras",
  title: "Cameras",
  make() {
    document.addEventListener("visibilitychange", () => cameras.forEach((camera) => camera.turn()));
    setInterval(() => cameras.forEach((camera) => { if (camera.visible) camera.tell(); }), 250);
    return {
      update(model, event) {
        if (event === "state") showCameras([...model.devices.values()]);
        if (event === "link" && model.link === "live") cameras.forEach((camera) => camera.renew());
      },
    };
  },
});
