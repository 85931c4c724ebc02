// The connection: the only module that sends requests to the team.  When the serving node is lost, it connects to
// another node, and repeats pending requests there.
import { raceNodes, storePages } from "./failover.js";
import { getTicket, getToken, storeSession } from "./session.js";
import { createStream } from "./stream.js";
import { text } from "./texts.js";

const API = "/api/v1/";
const PATIENCE = 5000;
const PAUSE = 300;
const RENEWED = 4 * 3600_000;
// Tokens for other nodes are valid for ten minutes.
const PASSES = 4 * 60_000;
const VIEWER = Math.random().toString(36).slice(2, 12);
const NAMES = ["state", "change", "yard", "event", "pages", "ticket", "beat"];
const pending = new Set();
let here = location.origin;
let search = null;
let requests = 0;
let left = null;
let pages = [];

// The origin of all requests: the node that serves now.
export const currentOrigin = () => here;

export const apiUrl = (path, at = here) => at + API + path;

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

// Search for a node that answers until one is found; concurrent callers share the search.
function findNode() {
  search ??= (async () => {
    for (;;) {
      const found = await raceNodes(here).catch(() => "");
      if (found) {
        if (found !== here) pending.forEach((request) => request.abort());
        here = found;
        search = null;
        return;
      }
      await pause(PAUSE);
    }
  })();
  return search;
}

// Send one request, without retries; the caller handles failures.
export async function fetchOnce(address, options) {
  if (left) return left;
  const request = new AbortController();
  const deadline = setTimeout(() => request.abort(), PATIENCE);
  pending.add(request);
  try {
    return await fetch(address, { ...options, signal: request.signal });
  } finally {
    clearTimeout(deadline);
    pending.delete(request);
  }
}

// A node carries out a request once per id, so requests can be repeated.  The id of a new task is derived from the id
// of its request, so a repetition at another node does not create a second task.
async function call(method, path, body) {
  const order = method !== "GET";
  const requestHeaders = order ? { "Content-Type": "application/json", "X-Swarm": "1", "Idempotency-Key": `${VIEWER}-${++requests}` } : {};
  // Each node gets only its own token.
  const options = () => ({
    method,
    headers: getToken(here) ? { ...requestHeaders, Authorization: `Bearer ${getToken(here)}` } : requestHeaders,
    body: order ? JSON.stringify(body) : undefined,
  });
  const end = performance.now() + PATIENCE;
  let answer;
  let at;
  while (!answer) {
    try {
      at = here;
      answer = await fetchOnce(apiUrl(path), options());
    } catch {
      await Promise.race([findNode(), pause(Math.max(0, end - performance.now()))]);
      if (performance.now() >= end) {
        throw new Error(text(order ? "error.no_answer_order" : "error.no_answer"));
      }
      await pause(50);
    }
  }
  const reply = await answer.json().catch(() => ({}));
  if (answer.ok) return { reply, at };
  const { field = "", problem, remedy } = reply.error ?? {};
  const message = problem ? `${field}: ${problem}; ${remedy}.` : text("error.failed", { status: String(answer.status) });
  throw Object.assign(new Error(message), { status: answer.status, field });
}

// Both return the node's answer, or throw an Error with a message for the user (with status and field if the node
// rejected the request).
export const get = async (path) => (await call("GET", path)).reply;
export const send = async (method, path, body = {}) => (await call(method, path, body)).reply;

// Get a session of the node that answers, and store it for that node.
export async function openSession(method, proof = {}) {
  const { reply, at } = await call(method, "session", proof);
  storeSession(at, reply);
}

// Fetch tokens for the team's other nodes in advance, because a lost node cannot issue them.
async function fetchPasses(listed) {
  const passes = await call("GET", "session/passes").catch(() => null);
  if (passes) storePages(listed, passes.reply, passes.at);
}

// End the session: the last request of a page.  Pending requests are aborted, because they would fail without a session.
export async function endSession() {
  pending.forEach((request) => request.abort());
  const last = send("DELETE", "session").catch(() => {});
  left = new Promise(() => {});
  await Promise.race([last, pause(PATIENCE)]);
}

// The next picture of a camera, as a Response: 200, 204 if there is no newer picture, or a refusal.
export const fetchFrame = (uuid, after, signal) => fetch(`${here}/shot/${uuid}?after=${after}&viewer=${VIEWER}&ticket=${getTicket(here)}`, { signal });

// Receive all events, as onEvent(name, data); "link" reports the connection: live, lost.  A hidden page receives nothing,
// and gets the missed changes when it is shown again.
export function openStream({ onEvent }) {
  let last = "";
  let served = here;
  let losses = 0;
  const stream = createStream({
    names: NAMES,
    url: () => {
      if (served !== here) last = "";
      served = here;
      return `${here}/events?since=${last}&ticket=${getTicket(here)}`;
    },
    onMessage(name, data, id) {
      last = id;
      losses = 0;
      onEvent("link", "live");
      // Failover to another node is possible only with a token for it.
      if (name === "pages") fetchPasses(pages = data).then(() => onEvent(name, data));
      else onEvent(name, data);
      if (name === "ticket") renewSession();
    },
    async onLost() {
      onEvent("link", "lost");
      await pause(Math.min(50 * 2 ** losses++, 2000));
      await findNode();
      updateStream();
    },
  });

  // A page that is open for days stays signed in; the stream is reopened, because its URL contains the old ticket.
  const renewSession = () => getToken(here) && openSession("PUT").then(updateStream, () => {});

  function updateStream() {
    if (document.hidden) stream.close();
    else stream.open();
  }

  document.addEventListener("visibilitychange", updateStream);
  // A hidden page receives no event, so it renews its session by itself.
  setInterval(() => { if (document.hidden) renewSession(); }, RENEWED);
  setInterval(() => fetchPasses(pages), PASSES);
  updateStream();
}
