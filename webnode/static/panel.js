// Panels: each part of the page is a panel in its own module, which registers it here.
//
// place    header, devices, device, groups, tasks, task, cameras, map, network, events, more
// order    0: the view itself, with the place as its root; others follow in their own roots, sorted by order
// needs    { role, has }: shown to visitors of that role, if the node has that service (model.me.role, model.has)
// make     make(root, { model, get, send, go }) fills the root and returns handlers, all optional:
//          update(model, event)  an event arrived: state, yard, beat, link, ... ; once at the start, with event ""
//          show(argument)        its place is shown: #device/UUID calls show("UUID")
//          hide()                its place is hidden
//          close()               the panel is removed: stop timers and requests
// load     instead of make, for panels that few pages need: () => import("./faults.js"), whose module exports make
export const panels = [];

export function registerPanel(description) {
  panels.push(description);
  panels.sort((a, b) => (a.order ?? 0) - (b.order ?? 0));
}
