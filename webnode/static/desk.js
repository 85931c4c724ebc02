// The desk: an operator's wishes on their way to the node, and the one line that says what came of them.
import { alike, at, several, words } from "./element.js";
import { ask } from "./link.js";

export function say(text) {
  words(at("line"), text);
}

// Who has a message, and who has not, and why.
export function delivery({ delivered = [], failed = {} }) {
  const no = alike(failed).map(([names, why]) => ` ${several(names)} ${names.length > 1 ? "have" : "has"} it not: ${why}.`).join("");
  const yes = delivered.length ? ` to ${several(delivered)}` : "";
  return no && !yes ? `Nobody has the message.${no}` : `Message sent${yes}.${no}`;
}

// Ask, and say in a line what happened; true where the wish was taken.
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
