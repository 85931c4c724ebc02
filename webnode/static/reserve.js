// The reserve: where else the team serves the page, and which of its nodes answers now.
import { has, sort } from "./session.js";

const VERSION = 1;
const PATIENCE = 800;
const LEAD = 150;
const KEPT = "swarm.pages";
const isLoopback = (url) => /^https?:\/\/(127\.|localhost[:/]|localhost$|\[::1\])/.test(url);
const isSecure = (url) => url.startsWith("https:");
let pages = kept();

// What was heard before counts for a page that the browser kept while its own node is gone.
function kept() {
  try {
    return JSON.parse(localStorage.getItem(KEPT)) ?? [];
  } catch {
    return [];
  }
}

// `passes` are the tokens for the other nodes, by uuid; the node that made them knows which are gateways of the team.
export function remember(told, passes, here) {
  pages = told;
  const more = told.filter((page) => passes[page.node]).map((page) => [page.url, passes[page.node]]);
  sort([here, location.origin, ...told.map(({ url }) => url)], Object.fromEntries(more));
  try {
    localStorage.setItem(KEPT, JSON.stringify(told));
  } catch {
    // A browser that keeps nothing goes on without.
  }
}

// Where there is no token for nothing is asked.  No page over TLS goes on with one without, and a page of this machine is
// meant for this machine alone.
function reachable({ url }) {
  if (!has(url)) return false;
  if (isSecure(location.origin) && !isSecure(url)) return false;
  return !isLoopback(url) || isLoopback(location.origin);
}

// A node that is frozen still takes connections: only a full answer counts.
async function present(url, node) {
  const answer = await fetch(`${url}/api/v1/node`, { cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
  const told = await answer.json();
  if (!answer.ok || told.api !== VERSION || (node && told.node !== node)) throw new Error(url);
  return url;
}

// The first that answers; `first` is asked first, each other a little later, or as soon as the one before has failed.
export async function race(first) {
  const known = new Map([[first, ""], [location.origin, ""]]);
  for (const page of pages.filter(reachable)) if (!known.has(page.url)) known.set(page.url, page.node);
  const asked = [];
  for (const [url, node] of known) {
    asked.push(present(url, node));
    const won = await Promise.race([Promise.any(asked).catch(() => ""), new Promise((done) => setTimeout(done, LEAD, ""))]);
    if (won) return won;
  }
  return Promise.any(asked);
}
