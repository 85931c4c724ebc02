// Groups: each agent's bid for a task, the winner that it computed, and whether they agree.
import { at, attribute, element, keyed, words } from "./element.js";
import { panel } from "./panel.js";

function showGroups(groups) {
  at("no-groups").hidden = groups.length > 0;
  keyed(at("groups"), groups, (group) => group.task,
    () => element("article", {}, element("h3"), element("p", { class: "point" }), element("ul", { class: "bids" })), update);
}

function point(group) {
  if (!group.assigned) return "No consensus yet: no agent has named a winner.";
  let told = `${group.assigned} – ${group.agree} of ${group.of} agree`;
  if (group.differ.length) told += `; ${group.differ.join(", ")} ${group.differ.length > 1 ? "differ" : "differs"}`;
  if (group.undecided.length) told += `; ${group.undecided.join(", ")} undecided`;
  return told;
}

function update(article, group) {
  const [title, told, bids] = article.children;
  words(title, group.title);
  words(told, point(group));
  attribute(told, "data-agree", Boolean(group.assigned) && group.agree === group.of);
  keyed(bids, group.members, (member) => member.uuid, bid, (item, member) => {
    const [name, bar, cost, choice] = item.children;
    attribute(item, "data-winner", member.uuid === group.assigned_uuid);
    words(name, member.name);
    bar.firstChild.style.width = `${100 * (member.share ?? 0)}%`;
    words(cost, member.cost === null ? (member.available ? "no bid" : "not free") : `${member.cost.toFixed(2)} m`);
    // The state of a standby contains its place: WAITING(2).
    const state = member.state.toLowerCase().replace(/\((\d+)\)$/, " as number $1");
    const detail = [state, member.post === null ? "" : `goes to ${member.post}°`,
      member.progress === null ? "" : `${Math.round(100 * member.progress)} % done`].filter(Boolean).join(", ");
    words(choice, `${member.choice ? `names ${member.choice}` : "undecided"}${member.token ? `, token ${member.token}` : ""}${member.why ? ` – ${member.why}` : ""}${detail ? ` (${detail})` : ""}`);
  });
}

function bid() {
  return element("li", {}, element("b"), element("span", { class: "bid", "aria-hidden": "true" }, element("i")),
    element("span", { class: "cost" }), element("span", { class: "choice" }));
}

panel({
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
