// This phone: takes part in the team as a device while the page is visible.
import { setAttribute, createBadge, createSvg, createElement, setBadge, setText } from "./element.js";
import { describeCameraError, openCamera } from "./phone-camera.js";
import { apiUrl, currentOrigin, fetchOnce, send } from "./connection.js";
import { formatNumber, text } from "./texts.js";

const STORAGE_KEY = "swarm.phone";
const RETRY_MS = 300;
const RETRY_REFUSED_MS = 2000;
const SHOWN_MS = 8000;

// The secret identifies the device, after a reload and at each web node of the team.
function readPhone() {
  try {
    const found = JSON.parse(localStorage.getItem(STORAGE_KEY)) ?? {};
    if (/^[0-9a-f]{64}$/.test(found.secret)) return found;
  } catch {
    // Unreadable data is replaced.
  }
  const bytes = crypto.getRandomValues(new Uint8Array(32));
  const secret = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return { secret, name: `phone-${secret.slice(0, 4)}` };
}

function storePhone(phone) {
  try {
    localStorage.setItem(STORAGE_KEY, JSON.stringify(phone));
  } catch {
    // Without storage the phone is a different device after a reload.
  }
}

// Authorized by ticket and without headers, so a browser sends no CORS preflight request.
const phoneUrl = (path, query, at) => apiUrl(`${path}?${new URLSearchParams(query)}`, at);

const pause = (ms) => new Promise((done) => setTimeout(done, Math.max(0, ms)));
const normalizeName = (value) => value.normalize("NFKD").replace(/[^\w-]+/g, "-").replace(/^-+|-+$/g, "").slice(0, 40);

// The reason why the camera cannot be used; "" if it can.
function findObstacle({ me, pages }) {
  if (!isSecureContext) {
    const secure = pages.find((page) => page.is_secure)?.url;
    return `${text("phone.remedy_https")} ${secure ? text("phone.open_secure", { url: secure }) : text("phone.no_https")}`;
  }
  if (!navigator.mediaDevices?.getUserMedia) return `${text("phone.no_camera")} ${text("phone.remedy_https")}`;
  if (me.role === "viewer") return text("phone.is_viewer");
  return "";
}

function describeDetection(detection) {
  if (!detection) return text("phone.no_target");
  const degrees = Math.round(detection.bearing * 180 / Math.PI);
  const key = degrees > 1 ? "phone.target_left" : degrees < -1 ? "phone.target_right" : "phone.target_ahead";
  return text(key, { metres: formatNumber(detection.distance, 2), degrees: Math.abs(degrees) });
}

export function make(root, { model, go }) {
  const phone = readPhone();
  let camera = null;
  let ticket = null;
  let stage = "off";
  let run = 0;
  let lock = null;

  if (!document.querySelector("link[href='/static/phone.css']")) {
    document.head.append(createElement("link", { rel: "stylesheet", href: "/static/phone.css" }));
  }
  const name = createElement("input", { id: "phone-name", maxlength: 40, autocomplete: "off", required: "" });
  const place = createElement("input", { id: "phone-place", type: "checkbox" });
  const start = createElement("button", { class: "primary" }, text("phone.join"));
  const no = createElement("button", { type: "button" }, text("phone.not_now"));
  const form = createElement("form", {},
    createElement("p", {}, text("phone.about")),
    createElement("label", { for: "phone-name" }, text("phone.name")), name,
    createElement("label", { class: "choice", for: "phone-place" }, place, ` ${text("phone.send_position")}`), createElement("div", { class: "row" }, start, no),
    createElement("p", { class: "hint" }, text("phone.privacy")));
  const canvas = createElement("canvas", { width: 208, height: 156, role: "img", "aria-label": text("phone.picture_label") });
  const ring = createSvg("rect", { rx: 3 });
  const overlay = createSvg("svg", { "aria-hidden": "true" }, ring);
  const request = createElement("p", { class: "request", role: "status" });
  const status = createBadge();
  const as = createElement("b");
  const task = createElement("span", { class: "hint" });
  const progress = createElement("progress", { max: 1, "aria-label": text("phone.progress_label") });
  const detectionLine = createElement("p", { class: "hint" });
  const stop = createElement("button", { class: "danger", type: "button" }, text("phone.leave"));
  const on = createElement("div", { class: "on" }, createElement("div", { class: "preview" }, canvas, overlay),
    createElement("div", {}, request, createElement("p", { class: "row as" }, as, status), task, progress, detectionLine, stop));
  const trouble = createElement("p", { class: "trouble", role: "alert" });
  root.append(form, trouble, on);
  name.value = phone.name;

  function show(next, line = "") {
    stage = next;
    form.hidden = stage === "on" || stage === "away";
    on.hidden = !form.hidden;
    start.disabled = stage === "asking" || findObstacle(model) !== "";
    setText(trouble, line || (stage === "off" ? findObstacle(model) : ""));
  }

  // Show the phone's state as the team sees it.
  function tell() {
    const device = model.devices.get(ticket?.uuid);
    setText(as, device?.name ?? phone.name);
    if (device) setBadge(status, device.status);
    status.hidden = !device;
    setText(task, device?.objective ?? "");
    task.hidden = !device?.objective;
    const mine = model.groups.get(device?.task)?.members.find(({ uuid }) => uuid === device.uuid);
    progress.hidden = device?.status !== "EXECUTING";
    progress.value = mine?.progress ?? 0;
  }

  function draw({ detection, of }) {
    setAttribute(overlay, "viewBox", `0 0 ${of.width} ${of.height}`);
    ring.setAttribute("visibility", detection ? "visible" : "hidden");
    if (detection) for (const [key, value] of Object.entries({ x: detection.box.left - 2, y: detection.box.top - 2, width: detection.box.width + 4, height: detection.box.height + 4 })) ring.setAttribute(key, value);
    setText(detectionLine, describeDetection(detection));
  }

  const keepScreenOn = async () => { lock = await navigator.wakeLock?.request("screen").catch(() => null); };

  const sendLeave = ({ uuid, ticket: proof, at }) => navigator.sendBeacon(phoneUrl(`phones/${uuid}/leave`, { ticket: proof }, at));

  async function join(mine) {
    const { secret } = phone;
    const at = currentOrigin();
    const reply = await send("POST", "phones", { secret, name: phone.name, width: canvas.width, height: canvas.height, ...camera.has });
    // A ticket is valid at the node that issued it; after a switch during the request, that node is unknown.
    if (at !== currentOrigin()) return;
    if (run === mine) ticket = { ...reply, at };
    else sendLeave({ ...reply, at });
  }

  // One picture in flight; if the node is lost, the phone joins at the next node.
  async function sendPictures(mine) {
    let fps = 10;
    let failing = false;
    while (run === mine) {
      const began = performance.now();
      try {
        const look = await camera.capture();
        if (run !== mine) return;
        draw(look);
        if (ticket?.at !== currentOrigin()) await join(mine);
        if (run !== mine) return;
        if (ticket?.at !== currentOrigin()) continue;
        const query = { ticket: ticket.ticket, values: JSON.stringify(look.values) };
        const answer = await fetchOnce(phoneUrl(`phones/${ticket.uuid}/look`, query, ticket.at), { method: "POST", body: look.picture });
        const reply = await answer.json();
        if (run !== mine) return;
        if (answer.ok) {
          fps = reply.fps;
          setText(request, reply.say);
          if (failing) setText(trouble, "");
          failing = false;
        } else if ([401, 403, 404].includes(answer.status)) ticket = null;
        else await pause(RETRY_MS);
      } catch (error) {
        if (run !== mine) return;
        failing = true;
        // Show messages of the node to the user, but not messages of the browser.
        setText(trouble, text("error.trying_again", { problem: error.status ? error.message : text("error.no_answer_now") }));
        await pause(error.status ? RETRY_REFUSED_MS : RETRY_MS);
      }
      tell();
      await pause(1000 / fps - (performance.now() - began));
    }
  }

  // Notify the node when the page closes, so that another device takes over immediately.
  function leave(next, line = "") {
    run += 1;
    if (ticket) sendLeave(ticket);
    ticket = null;
    camera?.close();
    camera = null;
    lock?.release().catch(() => {});
    lock = null;
    show(next, line);
  }

  async function begin(line = "") {
    const mine = run += 1;
    show("asking", text("phone.allow_camera"));
    try {
      const found = await openCamera(canvas, place.checked, () => {
        if (run === mine) leave("off", text("phone.camera_stopped"));
      });
      if (run !== mine) return found.close();
      camera = found;
    } catch (error) {
      if (run === mine) show("off", describeCameraError(error));
      return;
    }
    setText(request, text("phone.joining"));
    setText(detectionLine, text("phone.no_target"));
    show("on", line);
    setTimeout(() => { if (trouble.textContent === line) setText(trouble, ""); }, SHOWN_MS);
    keepScreenOn();
    sendPictures(mine);
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    phone.name = normalizeName(name.value) || phone.name;
    name.value = phone.name;
    storePhone(phone);
    begin();
  });
  no.addEventListener("click", () => go(""));
  stop.addEventListener("click", () => leave("off", text("phone.left")));
  // A hidden page gets no usable camera pictures: the phone leaves, and returns when the page is visible.
  const onHidden = () => {
    if (stage === "on") leave("away", text("phone.left_hidden"));
  };
  const onVisibility = () => {
    if (document.hidden) onHidden();
    else if (stage === "away") begin(text("phone.returned"));
  };
  document.addEventListener("visibilitychange", onVisibility);
  addEventListener("pagehide", onHidden);
  addEventListener("pageshow", onVisibility);
  show("off");

  return {
    show: () => { root.hidden = false; },
    // The phone still takes part while another view is shown.
    hide: () => { root.hidden = on.hidden; },
    update(_, event) {
      if (stage === "off" && event !== "beat") show("off", trouble.textContent && !findObstacle(model) ? trouble.textContent : "");
      if (stage === "on") tell();
    },
    close() {
      leave("off");
      document.removeEventListener("visibilitychange", onVisibility);
      removeEventListener("pagehide", onHidden);
      removeEventListener("pageshow", onVisibility);
    },
  };
}
