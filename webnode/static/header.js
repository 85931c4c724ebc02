// The header: the node to which the page is connected, and a status line with results and changes.
import { at, attribute, several, words } from "./element.js";
import { say } from "./desk.js";
import { panel } from "./panel.js";

const LINKS = { live: "connected", lost: "connection lost, trying again", wait: "connecting" };
let statuses = new Map();
let link = "wait";
let node = "";

function tellLink(now) {
  if (now === "lost") say("Connection lost. The page shows the last state received.");
  else if (link === "lost") say("Connected again.");
  link = now;
  attribute(at("link"), "data-link", now);
  attribute(document.body, "data-link", now);
  words(at("link"), LINKS[now]);
}

// Describe the changes since the last state for the status line.
function tellNews({ devices, tasks }, ...news) {
  for (const device of devices.values()) {
    const before = statuses.get(device.uuid);
    if (before === device.status || statuses.size === 0) continue;
    if (!before) news.push(`${device.name} joined`);
    else if (device.gone !== null) news.push(`${device.name} is gone`);
    else news.push(`${device.name} is ${device.status.toLowerCase()}`);
  }
  for (const task of tasks.values()) {
    const before = statuses.get(task.id);
    if (before && before !== task.status) news.push(`${task.title}: ${task.status.toLowerCase()}`);
  }
  statuses = new Map([...devices, ...tasks].map(([key, each]) => [key, each.status]));
  if (news.length) say(`${several(news)}.`);
}

// Show the serving node and the other web nodes; return the news if the serving node changed.
function tellNodes(model) {
  const others = model.pages.filter((page) => !page.is_self).map((page) => model.devices.get(page.node)?.name ?? "another");
  words(at("reserve"), others.length ? `, ${[...new Set(others)].join(", ")} in reserve` : "");
  if (model.node) words(at("node"), model.node);
  const news = node && model.node !== node ? [`${node} is lost, ${model.node} serves the page`] : [];
  node = model.node;
  return news;
}

panel({
  place: "header",
  title: "Swarm",
  make() {
    return {
      update(model, event) {
        if (event === "link") tellLink(model.link);
        if (event === "pages") tellNodes(model);
        if (event === "state") tellNews(model, ...tellNodes(model));
      },
    };
  },
});
