// Groups: each agent's bid for a task, the winner that it computed, and whether they agree.
import { byId, setAttribute, createElement, updateList, setText } from "./element.js";
import { registerPanel } from "./panel.js";
import { formatNumber, text, textOf } from "./texts.js";

function showGroups(groups) {
  byId("no-groups").hidden = groups.length > 0;
  updateList(byId("groups"), groups, (group) => group.task,
    () => createElement("article", {}, createElement("h3"), createElement("p", { class: "point" }), createElement("ul", { class: "bids" })), updateGroup);
}

function describeConsensus(group) {
  if (!group.assigned) return text("consensus.no_winner");
  const parts = [text("consensus.agree", { name: group.assigned, count: group.agree, total: group.of })];
  if (group.differ.length) parts.push(text("consensus.differ", { names: group.differ.join(", "), count: group.differ.length }));
  if (group.undecided.length) parts.push(text("consensus.undecided", { names: group.undecided.join(", ") }));
  return parts.join("; ");
}

function updateGroup(article, group) {
  const [title, told, bids] = article.children;
  setText(title, group.title);
  setText(told, describeConsensus(group));
  setAttribute(told, "data-agree", Boolean(group.assigned) && group.agree === group.of);
  updateList(bids, group.members, (member) => member.uuid, createBid, (item, member) => {
    const [name, bar, cost, choice] = item.children;
    setAttribute(item, "data-winner", member.uuid === group.assigned_uuid);
    setText(name, member.name);
    bar.firstChild.style.width = `${100 * (member.share ?? 0)}%`;
    setText(cost, member.cost === null ? text(member.available ? "consensus.no_bid" : "consensus.not_free") : text("length.metres", { value: formatNumber(member.cost, 2) }));
    // The state of a standby contains its position in the queue: WAITING(2).
    const [, state, rank] = /^(.*?)(?:\((\d+)\))?$/.exec(member.state);
    const said = textOf("agent.state", state, state.toLowerCase());
    const detail = [rank ? text("agent.state_as", { state: said, number: rank }) : said, member.post === null ? "" : text("agent.goes_to", { degrees: member.post }),
      member.progress === null ? "" : text("agent.progress", { percent: Math.round(100 * member.progress) })].filter(Boolean).join(", ");
    const named = [member.choice ? text("agent.names", { name: member.choice }) : text("agent.undecided"), member.token ? text("agent.token", { token: String(member.token) }) : ""].filter(Boolean).join(", ");
    setText(choice, `${named}${member.why ? ` – ${member.why}` : ""}${detail ? ` (${detail})` : ""}`);
  });
}

function createBid() {
  return createElement("li", {}, createElement("b"), createElement("span", { class: "bid", "aria-hidden": "true" }, createElement("i")),
    createElement("span", { class: "cost" }), createElement("span", { class: "choice" }));
}

registerPanel({
  place: "groups",
  make() {
    return {
      update(model, event) {
        if (event === "state") showGroups([...model.groups.values()]);
      },
    };
  },
});
