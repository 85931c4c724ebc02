// The desk: an operator's wishes on their way to the node, and the one line that says what came of them.
import { at, words } from "./element.js";

export function say(text) {
  words(at("line"), text);
}

export async function ask(path, body = {}, method = "POST") {
  let answer;
  try {
    answer = await fetch(path, {
      method,
      headers: { "Content-Type": "application/json", "X-Swarm": "1" },
      body: JSON.stringify(body),
      signal: AbortSignal.timeout(5000),
    });
  } catch {
    throw new Error("The node does not answer. Nothing may have been done; look at the state, then try again.");
  }
  const told = await answer.json().catch(() => ({}));
  if (!answer.ok) {
    const { field = "request", problem = `failed (${answer.status})`, remedy = "try again" } = told.error ?? {};
    throw new Error(`${field}: ${problem}; ${remedy}.`);
  }
  return told;
}

// Ask, and say in a line what happened; true where the wish was taken.
export async function wish(doing, path, { body, method, done, line = say } = {}) {
  line(`${doing} …`);
  try {
    const told = await ask(path, body, method);
    line(done ? done(told) : `${doing}: sent.`);
    return true;
  } catch (error) {
    line(error.message);
    return false;
  }
}
