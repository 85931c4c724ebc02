// The team: open or closed; the members of a closed team with their roles and the expiry of their certificates.
import { byId, setAttribute, createElement, updateList, formatDuration, setText } from "./element.js";
import { get } from "./connection.js";
import { pollWhileVisible } from "./polling.js";

const EVERY = 10000;

const day = (seconds) => new Date(1000 * seconds).toISOString().slice(0, 10);
const grouped = (digits) => digits.replace(/(.{4})(?=.)/g, "$1 ");
const renewal = ({ is_renewable }) => (is_renewable ? "renewed automatically" : "not renewed");

function ending({ until, name }, now) {
  return `expires in ${formatDuration(until - now)}; renew it with: swarm renew ${name}`;
}

function update(item, member, { model, me }) {
  const [name, roles, until, command] = item.children;
  const isHere = member.uuid === me || model.devices.get(member.uuid)?.gone === null;
  setText(name, member.name);
  setText(roles, `${member.roles.join(", ")}${isHere ? "" : ", not here"}`);
  setAttribute(item, "data-ending", member.is_ending);
  setText(until, member.is_ending ? `! ${ending(member, model.now)}` : `until ${day(member.until)}, ${renewal(member)}`);
  setText(command, model.me.role === "operator" && member.uuid !== me ? `swarm revoke ${member.name}` : "");
}

function show(told, model) {
  const isOpen = told.kind === "open";
  setText(byId("team-kind"), isOpen ? "Open team" : `Closed team ${told.name}`);
  setAttribute(byId("team-kind"), "data-kind", told.kind);
  setText(byId("team-about"), isOpen ? `Not protected: ${told.unprotected}. Create a closed team with: swarm init.`
    : `Fingerprint ${grouped(told.fingerprint)}. The certificate of this node is valid until ${day(told.until)}, ${renewal(told)}${told.is_ending ? `: expires in ${formatDuration(told.until - model.now)}` : ""}.`);
  const members = told.members ?? [];
  setText(byId("members-line"), isOpen ? "" : `${told.known} members${model.me.role === "operator" ? "; run the commands on the machine with the operator's key, not on a node" : ""}`);
  updateList(byId("members"), members, ({ uuid }) => uuid,
    () => createElement("li", {}, createElement("b"), createElement("span", { class: "roles" }), createElement("span", { class: "until" }), createElement("code")),
    (item, member) => update(item, member, { model, me: told.me }));
}

export function make(root, { model }) {
  root.append(createElement("h3", { id: "team-kind" }, "Team"), createElement("p", { class: "hint", id: "team-about", role: "status" }),
    createElement("p", { class: "hint", id: "members-line" }), createElement("ul", { id: "members" }));
  const close = pollWhileVisible(root, EVERY, async () => {
    try {
      show(await get("team"), model);
    } catch (error) {
      setText(byId("team-about"), error.message);
    }
  });
  return { close };
}
