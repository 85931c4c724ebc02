// The link: the only module that sends requests to the team.  When the serving node is lost it connects to another one,
// and repeats pending requests there.
import { race, remember } from "./reserve.js";
import { keep, ticket, token } from "./session.js";
import { stream } from "./stream.js";

const API = "/api/v1/";
const PATIENCE = 5000;
const PAUSE = 300;
const RENEWED = 4 * 3600_000;
// Tokens for other nodes are valid for ten minutes.
const PASSES = 4 * 60_000;
const VIEWER = Math.random().toString(36).slice(2, 12);
const NAMES = ["state", "change", "yard", "event", "pages", "ticket", "beat"];
const flying = new Set();
let here = location.origin;
let finding = null;
let orders = 0;
let left = null;
let pages = [];

// The origin of all requests: the node that serves now.
export const base = () => here;

export const where = (path, at = here) => at + API + path;

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

// Search for a node that answers until one is found; concurrent callers share the search.
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

// Send one request, without retries; the caller handles failures.
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

// A node carries out a request once per id, so requests can be repeated; the id of a new task is derived from it, so a
// task that is requested again at another node is the same one.
async function call(method, path, body) {
  const order = method !== "GET";
  const marks = order ? { "Content-Type": "application/json", "X-Swarm": "1", "Idempotency-Key": `${VIEWER}-${++orders}` } : {};
  // Each node gets only its own token.
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
        throw new Error(`The node does not answer. ${order ? "The order may not have been carried out; check" : "Check"} the state, then try again.`);
      }
      await pause(50);
    }
  }
  const told = await answer.json().catch(() => ({}));
  if (answer.ok) return { told, at };
  const { field = "request", problem = `failed (${answer.status})`, remedy = "try again" } = told.error ?? {};
  throw Object.assign(new Error(`${field}: ${problem}; ${remedy}.`), { status: answer.status, field });
}

// Both return the node's answer, or throw an Error with a message for people (with status and field, if refused).
export const get = async (path) => (await call("GET", path)).told;
export const ask = async (method, path, body = {}) => (await call(method, path, body)).told;

// Get a session of the node that answers, and store it for that node.
export async function signed(method, proof = {}) {
  const { told, at } = await call(method, "session", proof);
  keep(at, told);
}

// Fetch tokens for the team's other nodes in advance, as a lost node cannot issue them.
async function provide(told) {
  const passes = await call("GET", "session/passes").catch(() => null);
  if (passes) remember(told, passes.told, passes.at);
}

// End the session: the last request of a page.  Pending requests are aborted, as they would fail without a session.
export async function leave() {
  flying.forEach((flight) => flight.abort());
  const last = ask("DELETE", "session").catch(() => {});
  left = new Promise(() => {});
  await Promise.race([last, pause(PATIENCE)]);
}

// The next picture of a camera, as a Response: 200, 204 if there is no newer one, or a refusal.
export const frames = (uuid, after, signal) => fetch(`${here}/shot/${uuid}?after=${after}&viewer=${VIEWER}&ticket=${ticket(here)}`, { signal });

// Receive all events, as onEvent(name, data); "link" reports the connection: live, lost.  A hidden page receives nothing,
// and gets the missed changes when it is shown again.
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
      // Another node is a reserve only with a token for it.
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

  // A page that is open for days stays signed in; the stream is reopened, as its URL contains the old ticket.
  const renew = () => token(here) && signed("PUT").then(look, () => {});

  function look() {
    if (document.hidden) line.close();
    else line.open();
  }

  document.addEventListener("visibilitychange", look);
  // A hidden page receives no event that tells it to renew its session.
  setInterval(() => { if (document.hidden) renew(); }, RENEWED);
  setInterval(() => provide(pages), PASSES);
  look();
}
