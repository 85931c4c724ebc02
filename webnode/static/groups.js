// Groups: each agent's bid for a task, the winner that it computed, and whether they agree.
import { byId, setAttribute, createElement, updateList, setText } from "./element.js";
import { registerPanel } from "./panel.js";

function showGroups(groups) {
  byId("no-groups").hidden = groups.length > 0;
  updateList(byId("groups"), groups, (group) => group.task,
    () => createElement("article", {}, createElement("h3"), createElement("p", { class: "point" }), createElement("ul", { class: "bids" })), updateGroup);
}

function describeConsensus(group) {
  if (!group.assigned) return "No consensus yet: no agent has named a winner.";
  let told = `${group.assigned} – ${group.agree} of ${group.of} agree`;
  if (group.differ.length) told += `; ${group.differ.join(", ")} ${group.differ.length > 1 ? "differ" : "differs"}`;
  if (group.undecided.length) told += `; ${group.undecided.join(", ")} undecided`;
  return told;
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
    setText(cost, member.cost === null ? (member.available ? "no bid" : "not free") : `${member.cost.toFixed(2)} m`);
    // The state of a standby contains its place: WAITING(2).
    const state = member.state.toLowerCase().replace(/\((\d+)\)$/, " as number $1");
    const detail = [state, member.post === null ? "" : `goes to ${member.post}°`,
      member.progress === null ? "" : `${Math.round(100 * member.progress)} % done`].filter(Boolean).join(", ");
    setText(choice, `${member.choice ? `names ${member.choice}` : "undecided"}${member.token ? `, token ${member.token}` : ""}${member.why ? ` – ${member.why}` : ""}${detail ? ` (${detail})` : ""}`);
  });
}

function createBid() {
  return createElement("li", {}, createElement("b"), createElement("span", { class: "bid", "aria-hidden": "true" }, createElement("i")),
    createElement("span", { class: "cost" }), createElement("span", { class: "choice" }));
}

registerPanel({
  place: "groups",
  title: "Consensus",
  make() {
    return {
      update(model, event) {
        if (event === "state") showGroups([...model.groups.values()]);
      },
    };
  },
});
