// This phone: takes part in the team as a device while the page is visible.
import { attribute, badge, drawn, element, state, words } from "./element.js";
import { opened, why } from "./eye.js";
import { ask, base, fly, where } from "./link.js";

const KEPT = "swarm.phone";
const AGAIN = 300;
const LATER = 2000;
const READ = 8000;
const NONE = "No target in view.";
const REMEDY = "Browsers allow the camera on https pages, and on pages of this machine.";

// The secret identifies the device, after a reload and at each web node of the team.
function kept() {
  try {
    const found = JSON.parse(localStorage.getItem(KEPT)) ?? {};
    if (/^[0-9a-f]{64}$/.test(found.secret)) return found;
  } catch {
    // Unreadable data is replaced.
  }
  const bytes = crypto.getRandomValues(new Uint8Array(32));
  const secret = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return { secret, name: `phone-${secret.slice(0, 4)}` };
}

function keep(phone) {
  try {
    localStorage.setItem(KEPT, JSON.stringify(phone));
  } catch {
    // Without storage it is another device after a reload.
  }
}

// Authorized by ticket and without headers, so a browser sends no CORS preflight request.
const of = (path, query, at) => where(`${path}?${new URLSearchParams(query)}`, at);

const pause = (ms) => new Promise((done) => setTimeout(done, Math.max(0, ms)));
const asName = (text) => text.normalize("NFKD").replace(/[^\w-]+/g, "-").replace(/^-+|-+$/g, "").slice(0, 40);

// The reason why the camera cannot be used; "" if it can.
function hindrance({ me, pages }) {
  if (!isSecureContext) {
    const secure = pages.find((page) => page.is_secure)?.url;
    return `${REMEDY} ${secure ? `Open ${secure} and join there.` : "This node serves no https page: set tls = \"auto\" below [web] in its settings."}`;
  }
  if (!navigator.mediaDevices?.getUserMedia) return `This browser has no camera. ${REMEDY}`;
  if (me.role === "viewer") return "You are signed in as viewer. Ask an operator for an invitation for phones.";
  return "";
}

function seen(sight) {
  if (!sight) return "No red target in view.";
  const degrees = Math.round(sight.bearing * 180 / Math.PI);
  const side = degrees > 1 ? `, ${degrees}° left` : degrees < -1 ? `, ${-degrees}° right` : ", straight ahead";
  return `Target at about ${sight.distance.toFixed(2)} m${side}.`;
}

export function make(root, { model, go }) {
  const phone = kept();
  let eye = null;
  let ticket = null;
  let stage = "off";
  let run = 0;
  let lock = null;

  if (!document.querySelector("link[href='/static/phone.css']")) {
    document.head.append(element("link", { rel: "stylesheet", href: "/static/phone.css" }));
  }
  const name = element("input", { id: "phone-name", maxlength: 40, autocomplete: "off", required: "" });
  const place = element("input", { id: "phone-place", type: "checkbox" });
  const start = element("button", { class: "primary" }, "Take part");
  const no = element("button", { type: "button" }, "Not now");
  const form = element("form", {},
    element("p", {}, "Your phone becomes a device of the team. Its camera sees the target, it bids for tasks that need no motors, and it may ask you to point it at things."),
    element("label", { for: "phone-name" }, "Name"), name,
    element("label", { class: "choice", for: "phone-place" }, place, " Send the position"), element("div", { class: "row" }, start, no),
    element("p", { class: "hint" }, "Pictures are sent to the team while this page is visible, and are not stored."));
  const canvas = element("canvas", { width: 208, height: 156, role: "img", "aria-label": "Picture that this phone sends" });
  const ring = drawn("rect", { rx: 3 });
  const overlay = drawn("svg", { "aria-hidden": "true" }, ring);
  const said = element("p", { class: "said", role: "status" });
  const status = badge();
  const as = element("b");
  const task = element("span", { class: "hint" });
  const progress = element("progress", { max: 1, "aria-label": "Share of the task that is done" });
  const sightLine = element("p", { class: "hint" });
  const stop = element("button", { class: "danger", type: "button" }, "Stop taking part");
  const on = element("div", { class: "on" }, element("div", { class: "preview" }, canvas, overlay),
    element("div", {}, said, element("p", { class: "row as" }, as, status), task, progress, sightLine, stop));
  const trouble = element("p", { class: "trouble", role: "alert" });
  root.append(form, trouble, on);
  name.value = phone.name;

  function show(next, line = "") {
    stage = next;
    form.hidden = stage === "on" || stage === "away";
    on.hidden = !form.hidden;
    start.disabled = stage === "asking" || hindrance(model) !== "";
    words(trouble, line || (stage === "off" ? hindrance(model) : ""));
  }

  // Show the phone's state as the team sees it.
  function tell() {
    const device = model.devices.get(ticket?.uuid);
    words(as, device?.name ?? phone.name);
    if (device) state(status, device.status);
    status.hidden = !device;
    words(task, device?.objective ?? "");
    task.hidden = !device?.objective;
    const mine = model.groups.get(device?.task)?.members.find(({ uuid }) => uuid === device.uuid);
    progress.hidden = device?.status !== "EXECUTING";
    progress.value = mine?.progress ?? 0;
  }

  function draw({ sight, of }) {
    attribute(overlay, "viewBox", `0 0 ${of.width} ${of.height}`);
    ring.setAttribute("visibility", sight ? "visible" : "hidden");
    if (sight) for (const [key, value] of Object.entries({ x: sight.box.left - 2, y: sight.box.top - 2, width: sight.box.width + 4, height: sight.box.height + 4 })) ring.setAttribute(key, value);
    words(sightLine, seen(sight));
  }

  const wake = async () => { lock = await navigator.wakeLock?.request("screen").catch(() => null); };

  const goodbye = ({ uuid, ticket: proof, at }) => navigator.sendBeacon(of(`phones/${uuid}/leave`, { ticket: proof }, at));

  async function join(mine) {
    const { secret } = phone;
    const at = base();
    const told = await ask("POST", "phones", { secret, name: phone.name, width: canvas.width, height: canvas.height, ...eye.has });
    // A ticket is valid at the node that issued it; after a switch during the request that node is unknown.
    if (at !== base()) return;
    if (run === mine) ticket = { ...told, at };
    else goodbye({ ...told, at });
  }

  // One picture in flight; if the node is lost, the phone joins at the next one.
  async function looks(mine) {
    let fps = 10;
    let failing = false;
    while (run === mine) {
      const began = performance.now();
      try {
        const look = await eye.look();
        if (run !== mine) return;
        draw(look);
        if (ticket?.at !== base()) await join(mine);
        if (run !== mine) return;
        if (ticket?.at !== base()) continue;
        const query = { ticket: ticket.ticket, values: JSON.stringify(look.values) };
        const answer = await fly(of(`phones/${ticket.uuid}/look`, query, ticket.at), { method: "POST", body: look.picture });
        const told = await answer.json();
        if (run !== mine) return;
        if (answer.ok) {
          fps = told.fps;
          words(said, told.say);
          if (failing) words(trouble, "");
          failing = false;
        } else if ([401, 403, 404].includes(answer.status)) ticket = null;
        else await pause(AGAIN);
      } catch (error) {
        if (run !== mine) return;
        failing = true;
        // Errors of the node are for people; errors of the network are not.
        words(trouble, error.status ? `${error.message} Trying again.` : "The node does not answer. Trying again.");
        await pause(error.status ? LATER : AGAIN);
      }
      tell();
      await pause(1000 / fps - (performance.now() - began));
    }
  }

  // Tell the node also when the page closes, so that another device takes over at once.
  function leave(next, line = "") {
    run += 1;
    if (ticket) goodbye(ticket);
    ticket = null;
    eye?.close();
    eye = null;
    lock?.release().catch(() => {});
    lock = null;
    show(next, line);
  }

  async function begin(line = "") {
    const mine = run += 1;
    show("asking", "Allow the camera, if the browser asks.");
    try {
      const found = await opened(canvas, place.checked, () => {
        if (run === mine) leave("off", "The camera stopped: another program took it, or it was disconnected. Join again.");
      });
      if (run !== mine) return found.close();
      eye = found;
    } catch (error) {
      if (run === mine) show("off", why(error));
      return;
    }
    words(said, "Joining the team");
    words(sightLine, NONE);
    show("on", line);
    setTimeout(() => { if (trouble.textContent === line) words(trouble, ""); }, READ);
    wake();
    looks(mine);
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    phone.name = asName(name.value) || phone.name;
    name.value = phone.name;
    keep(phone);
    begin();
  });
  no.addEventListener("click", () => go(""));
  stop.addEventListener("click", () => leave("off", "This phone has left the team."));
  // A hidden page gets no usable camera pictures: the phone leaves, and returns when the page is visible.
  const hidden = () => {
    if (stage === "on") leave("away", "Left the team, as this page was hidden.");
  };
  const turned = () => {
    if (document.hidden) hidden();
    else if (stage === "away") begin("The phone left while this page was hidden, and has returned.");
  };
  document.addEventListener("visibilitychange", turned);
  addEventListener("pagehide", hidden);
  addEventListener("pageshow", turned);
  show("off");

  return {
    show: () => { root.hidden = false; },
    // The phone still takes part while another view is shown.
    hide: () => { root.hidden = on.hidden; },
    update(_, event) {
      if (stage === "off" && event !== "beat") show("off", trouble.textContent && !hindrance(model) ? trouble.textContent : "");
      if (stage === "on") tell();
    },
    close() {
      leave("off");
      document.removeEventListener("visibilitychange", turned);
      removeEventListener("pagehide", hidden);
      removeEventListener("pageshow", turned);
    },
  };
}
