// Requests: sends an operator's requests to the node, and shows the result in the status line.
import { groupByReason, byId, joinNames, setText } from "./element.js";
import { send } from "./connection.js";

export function showStatus(text) {
  setText(byId("status-line"), text);
}

// Describe who received a message, and why others did not.
export function describeDelivery({ delivered = [], failed = {} }) {
  const no = groupByReason(failed).map(([names, why]) => ` Not delivered to ${joinNames(names)}: ${why}.`).join("");
  const yes = delivered.length ? ` to ${joinNames(delivered)}` : "";
  return no && !yes ? `Message not delivered.${no}` : `Message sent${yes}.${no}`;
}

// Send a request and show its result in a line; true if it was accepted.
export async function sendRequest(doing, path, { body, method = "POST", done, line = showStatus } = {}) {
  line(`${doing} …`);
  try {
    const reply = await send(method, path, body);
    line(done ? done(reply) : `${doing}: sent.`);
    return true;
  } catch (error) {
    line(error.message);
    return false;
  }
}
