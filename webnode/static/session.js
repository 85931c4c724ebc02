// The session: what each web node gave when one signed in, or when it let the page go on at another; kept for the next
// visit.  A token is good at one node alone, so it is sent to the origin that it is kept for and nowhere else.
const KEY = "swarm.sessions";
let held = {};

try {
  held = JSON.parse(localStorage.getItem(KEY)) ?? {};
} catch {
  // What cannot be read is not there: one signs in again.
}

export const token = (origin) => held[origin]?.token ?? "";
// Stands for the session in an address; lets look only.
export const ticket = (origin) => held[origin]?.ticket ?? "";
export const has = (origin) => origin in held;

function put(sessions) {
  held = sessions;
  try {
    localStorage.setItem(KEY, JSON.stringify(held));
  } catch {
    // Where nothing may be kept, it lasts as long as the page.
  }
}

export const keep = (origin, session) => put({ ...held, [origin]: session });

// What is held for `origins` alone, with `more` beside it.
export function sort(origins, more) {
  put({ ...Object.fromEntries(Object.entries(held).filter(([origin]) => origins.includes(origin))), ...more });
}

export const forget = () => put({});
