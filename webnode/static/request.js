// Requests: sends an operator's requests to the node, and shows the result in the status line.
import { groupByReason, byId, joinNames, setText } from "./element.js";
import { send } from "./connection.js";
import { text } from "./texts.js";

export function showStatus(message) {
  setText(byId("status-line"), message);
}

// Describe which devices received a message, and why others did not.
export function describeDelivery({ delivered = [], failed = {} }) {
  const no = groupByReason(failed).map(([names, why]) => ` ${text("message.failed_to", { names: joinNames(names), reason: why })}`).join("");
  if (delivered.length) return text("message.sent_to", { names: joinNames(delivered) }) + no;
  return text(no ? "message.failed" : "message.sent") + no;
}

// Send a request and show its result in a line; true if it was accepted.
export async function sendRequest(doing, path, { body, method = "POST", done, line = showStatus } = {}) {
  line(text("request.runs", { action: doing }));
  try {
    const reply = await send(method, path, body);
    line(done ? done(reply) : text("request.sent", { action: doing }));
    return true;
  } catch (error) {
    line(error.message);
    return false;
  }
}
