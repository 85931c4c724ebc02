// The link: the one line from the page to its team; nobody else fetches anything.  When the node that serves is lost
// it goes on with another one, and what was asked meanwhile is asked there.
import { race, remember } from "./reserve.js";
import { keep, ticket, token } from "./session.js";
import { stream } from "./stream.js";

const API = "/api/v1/";
const PATIENCE = 5000;
const PAUSE = 300;
const RENEWED = 4 * 3600_000;
// What takes the page to another node lasts ten minutes.
const PASSES = 4 * 60_000;
const VIEWER = Math.random().toString(36).slice(2, 12);
const NAMES = ["state", "change", "yard", "event", "pages", "ticket", "beat"];
const flying = new Set();
let here = location.origin;
let finding = null;
let orders = 0;
let left = null;
let pages = [];

// Where the page is served from now: the origin of every address.
export const base = () => here;

export const where = (path, at = here) => at + API + path;

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

// Look for a node that answers until there is one; whoever calls meanwhile waits for the same.
function find() {
  finding ??= (async () => {
    for (;;) {
      const found = await race(here).catch(() => "");
      if (found) {
        if (found !== here) flying.forEach((flight) => flight.abort());
        here = found;
        finding = null;
        return;
      }
      await pause(PAUSE);
    }
  })();
  return finding;
}

// One question, once; whoever asks it knows what to make of no answer.
export async function fly(address, options) {
  if (left) return left;
  const flight = new AbortController();
  const deadline = setTimeout(() => flight.abort(), PATIENCE);
  flying.add(flight);
  try {
    return await fetch(address, { ...options, signal: flight.signal });
  } finally {
    clearTimeout(deadline);
    flying.delete(flight);
  }
}

// A node does once what has one id, so that it can be asked again; the id of a new task is made of it, so that a task
// that is asked for again at another node is the same one.
async function call(method, path, body) {
  const order = method !== "GET";
  const marks = order ? { "Content-Type": "application/json", "X-Swarm": "1", "Idempotency-Key": `${VIEWER}-${++orders}` } : {};
  // Each node is shown its own token, and none where there is none for it.
  const options = () => ({
    method,
    headers: token(here) ? { ...marks, Authorization: `Bearer ${token(here)}` } : marks,
    body: order ? JSON.stringify(body) : undefined,
  });
  const end = performance.now() + PATIENCE;
  let answer;
  let at;
  while (!answer) {
    try {
      at = here;
      answer = await fly(where(path), options());
    } catch {
      await Promise.race([find(), pause(Math.max(0, end - performance.now()))]);
      if (performance.now() >= end) {
        throw new Error(`The node does not answer. ${order ? "Nothing may have been done; look" : "Look"} at the state, then try again.`);
      }
      await pause(50);
    }
  }
  const told = await answer.json().catch(() => ({}));
  if (answer.ok) return { told, at };
  const { field = "request", problem = `failed (${answer.status})`, remedy = "try again" } = told.error ?? {};
  throw Object.assign(new Error(`${field}: ${problem}; ${remedy}.`), { status: answer.status, field });
}

// Both give what the node answers, or throw an Error whose message is for people (with status and field, if it refused).
export const get = async (path) => (await call("GET", path)).told;
export const ask = async (method, path, body = {}) => (await call(method, path, body)).told;

// A session of the node that answers, kept for that one.
export async function signed(method, proof = {}) {
  const { told, at } = await call(method, "session", proof);
  keep(at, told);
}

// Has tokens ready for the team's other nodes, as the one that serves can be asked for none when it is lost.
async function provide(told) {
  const passes = await call("GET", "session/passes").catch(() => null);
  if (passes) remember(told, passes.told, passes.at);
}

// Says goodbye: the last thing that a page asks.  What is under way is dropped, or it would come without a session.
export async function leave() {
  flying.forEach((flight) => flight.abort());
  const last = ask("DELETE", "session").catch(() => {});
  left = new Promise(() => {});
  await Promise.race([last, pause(PATIENCE)]);
}

// The next picture of a camera, as a Response: 200, 204 where there is no newer one, or a refusal.
export const frames = (uuid, after, signal) => fetch(`${here}/shot/${uuid}?after=${after}&viewer=${VIEWER}&ticket=${ticket(here)}`, { signal });

// Everything that comes, as onEvent(name, data); "link" says whether anything does: live, lost.  A page that nobody
// sees hears nothing, and is told what it missed when somebody looks again.
export function open({ onEvent }) {
  let last = "";
  let served = here;
  let losses = 0;
  const line = stream({
    names: NAMES,
    url: () => {
      if (served !== here) last = "";
      served = here;
      return `${here}/events?since=${last}&ticket=${ticket(here)}`;
    },
    heard(name, data, id) {
      last = id;
      losses = 0;
      onEvent("link", "live");
      // Another node stands in reserve when there is a token for it.
      if (name === "pages") provide(pages = data).then(() => onEvent(name, data));
      else onEvent(name, data);
      if (name === "ticket") renew();
    },
    async lost() {
      onEvent("link", "lost");
      await pause(Math.min(50 * 2 ** losses++, 2000));
      await find();
      look();
    },
  });

  // A page that is left open for days stays signed in; the stream is opened anew, as its address holds the old ticket.
  const renew = () => token(here) && signed("PUT").then(look, () => {});

  function look() {
    if (document.hidden) line.close();
    else line.open();
  }

  document.addEventListener("visibilitychange", look);
  // One that is not looked at hears nothing, and cannot be told that it is time.
  setInterval(() => { if (document.hidden) renew(); }, RENEWED);
  setInterval(() => provide(pages), PASSES);
  look();
}
