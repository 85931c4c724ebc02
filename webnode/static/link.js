// The link: the one line from the page to its node; nobody else fetches anything.
import { ticket, token } from "./session.js";
import { stream } from "./stream.js";

const API = "/api/v1/";
const PATIENCE = 5000;
const VIEWER = Math.random().toString(36).slice(2, 12);
let orders = 0;

// Where the page is served from: the origin of every address.
export const base = () => location.origin;

async function call(method, path, body) {
  const order = method !== "GET";
  const signed = token() ? { Authorization: `Bearer ${token()}` } : {};
  let answer;
  try {
    answer = await fetch(base() + API + path, {
      method,
      headers: order ? { ...signed, "Content-Type": "application/json", "X-Swarm": "1", "Idempotency-Key": `${VIEWER}-${++orders}` } : signed,
      body: order ? JSON.stringify(body) : undefined,
      signal: AbortSignal.timeout(PATIENCE),
    });
  } catch {
    throw new Error(`The node does not answer. ${order ? "Nothing may have been done; look" : "Look"} at the state, then try again.`);
  }
  const told = await answer.json().catch(() => ({}));
  if (answer.ok) return told;
  const { field = "request", problem = `failed (${answer.status})`, remedy = "try again" } = told.error ?? {};
  throw Object.assign(new Error(`${field}: ${problem}; ${remedy}.`), { status: answer.status, field });
}

// Both give what the node answers, or throw an Error whose message is for people (with status and field, if it refused).
export const get = (path) => call("GET", path);
export const ask = (method, path, body = {}) => call(method, path, body);

// The next picture of a camera, as a Response: 200, 204 where there is no newer one, or a refusal.
export const frames = (uuid, after, signal) => fetch(`${base()}/shot/${uuid}?after=${after}&viewer=${VIEWER}&ticket=${ticket()}`, { signal });

// Everything that comes, as onEvent(name, data); "link" says whether anything does: live, lost.
export function open({ onEvent }) {
  stream(() => `${base()}/events?ticket=${ticket()}`, ["state", "yard", "beat"], onEvent);
}
