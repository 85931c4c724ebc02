// The desk: sends an operator's requests to the node, and shows the result in the status line.
import { alike, at, several, words } from "./element.js";
import { ask } from "./link.js";

export function say(text) {
  words(at("line"), text);
}

// Describe who received a message, and why others did not.
export function delivery({ delivered = [], failed = {} }) {
  const no = alike(failed).map(([names, why]) => ` Not delivered to ${several(names)}: ${why}.`).join("");
  const yes = delivered.length ? ` to ${several(delivered)}` : "";
  return no && !yes ? `Message not delivered.${no}` : `Message sent${yes}.${no}`;
}

// Send a request and show its result in a line; true if it was accepted.
export async function wish(doing, path, { body, method = "POST", done, line = say } = {}) {
  line(`${doing} …`);
  try {
    const told = await ask(method, path, body);
    line(done ? done(told) : `${doing}: sent.`);
    return true;
  } catch (error) {
    line(error.message);
    return false;
  }
}
