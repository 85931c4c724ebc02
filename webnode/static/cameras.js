// Cameras: one loop and one request in flight per camera; a camera that is not in view fetches nothing.
import { byId, setAttribute, createElement, updateList, setText } from "./element.js";
import { fetchFrame } from "./connection.js";
import { registerPanel } from "./panel.js";
import { formatNumber, text } from "./texts.js";

const cameras = new Map();
const figures = new WeakMap();
// One observer reports which of all figures are in view.
const observer = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) figures.get(target)?.setVisible(isIntersecting);
});

class Camera {
  constructor(uuid) {
    this.uuid = uuid;
    this.seq = "";
    this.at = 0;
    this.visible = false;
    this.gone = false;
    this.closed = false;
    this.request = null;
    this.isRestarted = false;
    this.problem = "";
    this.canvas = createElement("canvas", { width: 208, height: 160, role: "img" });
    this.name = createElement("b");
    this.age = createElement("span", { class: "age" });
    this.figure = createElement("figure", { "data-camera": "wait" }, this.canvas, createElement("figcaption", {}, this.name, this.age));
    figures.set(this.figure, this);
    observer.observe(this.figure);
  }

  setVisible(visible) {
    this.visible = visible;
    this.updateLoop();
    this.showAge();
  }

  get isWanted() {
    return this.visible && !this.gone && !this.closed && !document.hidden;
  }

  // Start the loop if the camera is in view; otherwise abort the pending request.
  updateLoop() {
    if (!this.isWanted) this.request?.abort();
    else if (!this.request) this.loop();
  }

  async loop() {
    while (this.isWanted) {
      this.request = new AbortController();
      const deadline = setTimeout(() => this.request?.abort(), 12000);
      try {
        const answer = await fetchFrame(this.uuid, this.seq, this.request.signal);
        if (answer.status === 200) {
          const picture = await createImageBitmap(await answer.blob());
          this.seq = answer.headers.get("X-Seq");
          this.at = performance.now() - 1000 * Number(answer.headers.get("X-Age"));
          this.draw(picture);
          this.problem = "";
        } else if (answer.status !== 204) {
          this.problem = (await answer.json().catch(() => ({}))).error?.problem ?? text("camera.no_picture");
          await pause();
        }
      } catch {
        if (this.isWanted && !this.isRestarted) await pause();
        this.isRestarted = false;
      }
      clearTimeout(deadline);
    }
    this.request = null;
  }

  // Request from the node that serves now; a pending answer of the previous node is no longer needed.
  restart() {
    this.seq = "";
    this.isRestarted = this.request !== null;
    this.request?.abort();
  }

  draw(picture) {
    if (this.canvas.width !== picture.width) Object.assign(this.canvas, { width: picture.width, height: picture.height });
    this.canvas.getContext("2d").drawImage(picture, 0, 0);
    picture.close();
  }

  showAge() {
    const age = (performance.now() - this.at) / 1000;
    const state = this.gone ? "gone" : !this.at ? "wait" : age < 1 ? "live" : "late";
    const seen = this.at ? text("camera.age", { seconds: formatNumber(age, age < 10 ? 1 : 0) }) : text("camera.no_picture_yet");
    setAttribute(this.figure, "data-camera", state);
    setText(this.age, this.gone ? text("camera.gone", { age: seen }) : this.problem && state !== "live" ? this.problem : state === "live" ? text("camera.live", { age: seen }) : seen);
  }

  close() {
    this.closed = true;
    observer.unobserve(this.figure);
    this.request?.abort();
  }
}

const pause = () => new Promise((done) => setTimeout(done, 1000));

function showCameras(devices) {
  const seeing = devices.filter((device) => device.capabilities.camera);
  byId("no-cameras").hidden = seeing.length > 0;
  for (const [uuid, camera] of cameras) {
    if (seeing.some((device) => device.uuid === uuid)) continue;
    camera.close();
    cameras.delete(uuid);
  }
  updateList(byId("cameras"), seeing, (device) => device.uuid,
    (device) => {
      cameras.set(device.uuid, new Camera(device.uuid));
      return cameras.get(device.uuid).figure;
    },
    (figure, device) => {
      const camera = cameras.get(device.uuid);
      setText(camera.name, device.name);
      setAttribute(camera.canvas, "aria-label", text("camera.label", { name: device.name }));
      camera.gone = device.gone !== null;
      camera.updateLoop();
    });
}

registerPanel({
  place: "cameras",
  make() {
    document.addEventListener("visibilitychange", () => cameras.forEach((camera) => camera.updateLoop()));
    setInterval(() => cameras.forEach((camera) => { if (camera.visible) camera.showAge(); }), 250);
    return {
      update(model, event) {
        if (event === "state") showCameras([...model.devices.values()]);
        if (event === "link" && model.link === "live") cameras.forEach((camera) => camera.restart());
      },
    };
  },
});
