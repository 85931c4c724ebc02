// The team: open or closed; the members of a closed team with their roles and the expiry of their certificates.
import { byId, setAttribute, createElement, updateList, formatDuration, setText } from "./element.js";
import { get } from "./connection.js";
import { pollWhileVisible } from "./polling.js";
import { formatDate, text } from "./texts.js";

const EVERY = 10000;

const grouped = (digits) => digits.replace(/(.{4})(?=.)/g, "$1 ");
const renewal = ({ is_renewable }) => text(is_renewable ? "team.renewed" : "team.not_renewed");

function ending({ until, name }, now) {
  return text("team.member_expires", { time: formatDuration(until - now), name });
}

function update(item, member, { model, me }) {
  const [name, roles, until, command] = item.children;
  const isHere = member.uuid === me || model.devices.get(member.uuid)?.gone === null;
  setText(name, member.name);
  setText(roles, [...member.roles, ...(isHere ? [] : [text("team.not_here")])].join(", "));
  setAttribute(item, "data-ending", member.is_ending);
  setText(until, member.is_ending ? `! ${ending(member, model.now)}` : text("team.member_until", { date: formatDate(member.until), renewal: renewal(member) }));
  setText(command, model.me.role === "operator" && member.uuid !== me ? `swarm revoke ${member.name}` : "");
}

function show(told, model) {
  const isOpen = told.kind === "open";
  setText(byId("team-kind"), isOpen ? text("team.open") : text("team.closed", { name: told.name }));
  setAttribute(byId("team-kind"), "data-kind", told.kind);
  setText(byId("team-about"), isOpen ? text("team.unprotected", { problem: told.unprotected })
    : text(told.is_ending ? "team.about_expires" : "team.about", {
      fingerprint: grouped(told.fingerprint), date: formatDate(told.until), renewal: renewal(told), time: formatDuration(told.until - model.now),
    }));
  const members = told.members ?? [];
  setText(byId("members-line"), isOpen ? "" : text(model.me.role === "operator" ? "team.members_operator" : "team.members", { count: told.known }));
  updateList(byId("members"), members, ({ uuid }) => uuid,
    () => createElement("li", {}, createElement("b"), createElement("span", { class: "roles" }), createElement("span", { class: "until" }), createElement("code")),
    (item, member) => update(item, member, { model, me: told.me }));
}

export function make(root, { model }) {
  root.append(createElement("h3", { id: "team-kind" }, text("team.title")), createElement("p", { class: "hint", id: "team-about", role: "status" }),
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
