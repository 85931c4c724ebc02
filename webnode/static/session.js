// The session: what the node gave when one signed in, kept for the next visit; good at every web node of the team.
const KEY = "swarm-session";
let held = {};

try {
  held = JSON.parse(localStorage.getItem(KEY)) ?? {};
} catch {
  // What cannot be read is not there: one signs in again.
}

export const token = () => held.token ?? "";
// Stands for the session in an address; lets look only.
export const ticket = () => held.ticket ?? "";

export function keep(session) {
  held = session;
  try {
    localStorage.setItem(KEY, JSON.stringify(session));
  } catch {
    // Where nothing may be kept, it lasts as long as the page.
  }
}

export const forget = () => keep({});
