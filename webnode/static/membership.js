// The team: open or closed; the members of a closed team with their roles and the expiry of their certificates.
import { at, attribute, element, keyed, span, words } from "./element.js";
import { get } from "./link.js";
import { watch } from "./watch.js";

const EVERY = 10000;

const day = (seconds) => new Date(1000 * seconds).toISOString().slice(0, 10);
const grouped = (digits) => digits.replace(/(.{4})(?=.)/g, "$1 ");
const renewal = ({ is_renewable }) => (is_renewable ? "renewed automatically" : "not renewed");

function ending({ until, name }, now) {
  return `expires in ${span(until - now)}; renew it with: swarm renew ${name}`;
}

function update(item, member, { model, me }) {
  const [name, roles, until, command] = item.children;
  const isHere = member.uuid === me || model.devices.get(member.uuid)?.gone === null;
  words(name, member.name);
  words(roles, `${member.roles.join(", ")}${isHere ? "" : ", not here"}`);
  attribute(item, "data-ending", member.is_ending);
  words(until, member.is_ending ? `! ${ending(member, model.now)}` : `until ${day(member.until)}, ${renewal(member)}`);
  words(command, model.me.role === "operator" && member.uuid !== me ? `swarm revoke ${member.name}` : "");
}

function show(told, model) {
  const isOpen = told.kind === "open";
  words(at("team-kind"), isOpen ? "Open team" : `Closed team ${told.name}`);
  attribute(at("team-kind"), "data-kind", told.kind);
  words(at("team-about"), isOpen ? `Not protected: ${told.unprotected}. Create a closed team with: swarm init.`
    : `Fingerprint ${grouped(told.fingerprint)}. The certificate of this node is valid until ${day(told.until)}, ${renewal(told)}${told.is_ending ? `: expires in ${span(told.until - model.now)}` : ""}.`);
  const members = told.members ?? [];
  words(at("members-line"), isOpen ? "" : `${told.known} members${model.me.role === "operator" ? "; run the commands on the machine with the operator's key, not on a node" : ""}`);
  keyed(at("members"), members, ({ uuid }) => uuid,
    () => element("li", {}, element("b"), element("span", { class: "roles" }), element("span", { class: "until" }), element("code")),
    (item, member) => update(item, member, { model, me: told.me }));
}

export function make(root, { model }) {
  root.append(element("h3", { id: "team-kind" }, "Team"), element("p", { class: "hint", id: "team-about", role: "status" }),
    element("p", { class: "hint", id: "members-line" }), element("ul", { id: "members" }));
  const close = watch(root, EVERY, async () => {
    try {
      show(await get("team"), model);
    } catch (error) {
      words(at("team-about"), error.message);
    }
  });
  return { close };
}
