// The header: the node to which the page is connected, and a status line with results and changes.
import { byId, setAttribute, joinNames, setText } from "./element.js";
import { showStatus } from "./request.js";
import { registerPanel } from "./panel.js";

const LINKS = { live: "connected", lost: "connection lost, trying again", wait: "connecting" };
let statuses = new Map();
let link = "wait";
let node = "";

function showConnection(now) {
  if (now === "lost") showStatus("Connection lost. The page shows the last state received.");
  else if (link === "lost") showStatus("Connected again.");
  link = now;
  setAttribute(byId("link"), "data-link", now);
  setAttribute(document.body, "data-link", now);
  setText(byId("link"), LINKS[now]);
}

// Describe the changes since the last state for the status line.
function showChanges({ devices, tasks }, ...news) {
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
  if (news.length) showStatus(`${joinNames(news)}.`);
}

// Show the serving node and the other web nodes; return the news if the serving node changed.
function showNodes(model) {
  const others = model.pages.filter((page) => !page.is_self).map((page) => model.devices.get(page.node)?.name ?? "another");
  setText(byId("standby-nodes"), others.length ? `, ${[...new Set(others)].join(", ")} in reserve` : "");
  if (model.node) setText(byId("node"), model.node);
  const news = node && model.node !== node ? [`${node} is lost, ${model.node} serves the page`] : [];
  node = model.node;
  return news;
}

registerPanel({
  place: "header",
  title: "Swarm",
  make() {
    return {
      update(model, event) {
        if (event === "link") showConnection(model.link);
        if (event === "pages") showNodes(model);
        if (event === "state") showChanges(model, ...showNodes(model));
      },
    };
  },
});
