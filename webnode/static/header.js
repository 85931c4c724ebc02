// The header: the node to which the page is connected, and a status line with results and changes.
import { byId, describeStatus, setAttribute, joinNames, setText } from "./element.js";
import { showStatus } from "./request.js";
import { registerPanel } from "./panel.js";
import { text } from "./texts.js";

let statuses = new Map();
let link = "wait";
let node = "";

function showConnection(now) {
  if (now === "lost") showStatus(text("connection.lost_status"));
  else if (link === "lost") showStatus(text("connection.again"));
  link = now;
  setAttribute(byId("link"), "data-link", now);
  setAttribute(document.body, "data-link", now);
  setText(byId("link"), text(`connection.state.${now}`));
}

// Describe the changes since the last state for the status line.
function showChanges({ devices, tasks }, ...news) {
  for (const device of devices.values()) {
    const before = statuses.get(device.uuid);
    if (before === device.status || statuses.size === 0) continue;
    if (!before) news.push(text("news.joined", { name: device.name }));
    else if (device.gone !== null) news.push(text("news.gone", { name: device.name }));
    else news.push(text("news.device", { name: device.name, status: describeStatus(device.status) }));
  }
  for (const task of tasks.values()) {
    const before = statuses.get(task.id);
    if (before && before !== task.status) news.push(text("news.task", { title: task.title, status: describeStatus(task.status) }));
  }
  statuses = new Map([...devices, ...tasks].map(([key, each]) => [key, each.status]));
  if (news.length) showStatus(`${joinNames(news)}.`);
}

// Show the serving node and the other web nodes; return the news if the serving node changed.
function showNodes(model) {
  const others = model.pages.filter((page) => !page.is_self).map((page) => model.devices.get(page.node)?.name ?? text("connection.another_node"));
  setText(byId("standby-nodes"), others.length ? text("connection.standby", { names: [...new Set(others)].join(", ") }) : "");
  if (model.node) setText(byId("node"), model.node);
  const news = node && model.node !== node ? [text("news.node_lost", { lost: node, node: model.node })] : [];
  node = model.node;
  return news;
}

registerPanel({
  place: "header",
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
