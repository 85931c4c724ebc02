// Panels: each part of the page is one, in a module of its own that says here where it belongs.
//
// place    where: header, devices, device, groups, tasks, task, cameras, map, network, events, more
// order    0: the view itself, whose root is the place; others stand below it, each in a root of its own, by number
// title    its name, for people
// needs    { role, has }: shown to visitors of that role, where the node has that (model.me.role, model.has)
// make     make(root, { model, get, ask, go }) fills the root and returns what it answers to, each if it wants:
//          update(model, event)  something came: state, yard, beat, link, ... ; once at the start, with event ""
//          show(argument)        its place is the one that is looked at: #device/UUID shows ("UUID")
//          hide()                it is no more
//          close()               it is taken away: end what runs
// load     instead of make, for what few need: () => import("./faults.js"), whose module exports make
export const panels = [];

export function panel(description) {
  panels.push(description);
  panels.sort((a, b) => (a.order ?? 0) - (b.order ?? 0));
}
