// The session: tokens from sign-in and for other web nodes, stored for the next visit.  A token is valid at one node, so
// it is sent to that origin only.
const KEY = "swarm.sessions";
let held = {};

try {
  held = JSON.parse(localStorage.getItem(KEY)) ?? {};
} catch {
  // Unreadable data is dropped; the visitor signs in again.
}

export const token = (origin) => held[origin]?.token ?? "";
// Stands for the session in a URL; read only.
export const ticket = (origin) => held[origin]?.ticket ?? "";
export const has = (origin) => origin in held;

function put(sessions) {
  held = sessions;
  try {
    localStorage.setItem(KEY, JSON.stringify(held));
  } catch {
    // Without storage the session is lost with the page.
  }
}

export const keep = (origin, session) => put({ ...held, [origin]: session });

// Keep the sessions of `origins` only, and add `more`.
export function sort(origins, more) {
  put({ ...Object.fromEntries(Object.entries(held).filter(([origin]) => origins.includes(origin))), ...more });
}

export const forget = () => put({});
