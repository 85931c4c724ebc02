// Failover: the URLs of the team's other web nodes, and the search for a node that answers.
import { hasSession, replaceSessions } from "./session.js";

const VERSION = 1;
const PATIENCE = 800;
const LEAD = 150;
const STORAGE_KEY = "swarm.pages";
const isLoopback = (url) => /^https?:\/\/(127\.|localhost[:/]|localhost$|\[::1\])/.test(url);
const isSecure = (url) => url.startsWith("https:");
let pages = readPages();

// The stored list serves a page that was opened from the cache while its node is gone.
function readPages() {
  try {
    return JSON.parse(localStorage.getItem(STORAGE_KEY)) ?? [];
  } catch {
    return [];
  }
}

// `passes` are the tokens for the other nodes, by uuid; the node issues them only for gateways of the team.
export function storePages(listed, passes, here) {
  pages = listed;
  const more = listed.filter((page) => passes[page.node]).map((page) => [page.url, passes[page.node]]);
  replaceSessions([here, location.origin, ...listed.map(({ url }) => url)], Object.fromEntries(more));
  try {
    localStorage.setItem(STORAGE_KEY, JSON.stringify(listed));
  } catch {
    // Without storage the list is lost with the page.
  }
}

// Nodes for which the page has no token are skipped.  A page over TLS does not switch to a URL without TLS, and only a
// page of this machine uses loopback URLs.
function isReachable({ url }) {
  if (!hasSession(url)) return false;
  if (isSecure(location.origin) && !isSecure(url)) return false;
  return !isLoopback(url) || isLoopback(location.origin);
}

// A frozen node still accepts connections, so only a complete answer shows that a node works.
async function checkNode(url, node) {
  const answer = await fetch(`${url}/api/v1/node`, { cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
  const reply = await answer.json();
  if (!answer.ok || reply.api !== VERSION || (node && reply.node !== node)) throw new Error(url);
  return url;
}

// Return the first node that answers.  `first` is asked first; each further node is asked a little later, or when the
// previous node fails.
export async function raceNodes(first) {
  const known = new Map([[first, ""], [location.origin, ""]]);
  for (const page of pages.filter(isReachable)) if (!known.has(page.url)) known.set(page.url, page.node);
  const asked = [];
  for (const [url, node] of known) {
    asked.push(checkNode(url, node));
    const won = await Promise.race([Promise.any(asked).catch(() => ""), new Promise((done) => setTimeout(done, LEAD, ""))]);
    if (won) return won;
  }
  return Promise.any(asked);
}
