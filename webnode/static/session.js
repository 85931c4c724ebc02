// The session: tokens from sign-in and for other web nodes, stored for the next visit.  A token is valid at one node, so
// it is sent to that origin only.
const KEY = "swarm.sessions";
let sessionsByOrigin = {};

try {
  sessionsByOrigin = JSON.parse(localStorage.getItem(KEY)) ?? {};
} catch {
  // Unreadable data is dropped; the visitor signs in again.
}

export const getToken = (origin) => sessionsByOrigin[origin]?.token ?? "";
// A credential of the session for URLs; it only permits reading.
export const getTicket = (origin) => sessionsByOrigin[origin]?.ticket ?? "";
export const hasSession = (origin) => origin in sessionsByOrigin;

function store(sessions) {
  sessionsByOrigin = sessions;
  try {
    localStorage.setItem(KEY, JSON.stringify(sessionsByOrigin));
  } catch {
    // Without storage the session is lost with the page.
  }
}

export const storeSession = (origin, session) => store({ ...sessionsByOrigin, [origin]: session });

// Keep the sessions of `origins` only, and add `more`.
export function replaceSessions(origins, more) {
  store({ ...Object.fromEntries(Object.entries(sessionsByOrigin).filter(([origin]) => origins.includes(origin))), ...more });
}

export const clearSessions = () => store({});
