// Keeping: where the browser allows it (https, or this machine) it keeps the page's files for when the node is gone.
const SHELL = "swarm.shell";
// What is asked for later comes in advance, so that it is there when its node is not.
for (const name of ["history", "invite", "phone"]) import(`./${name}.js`).catch(() => {});

// All of it or nothing: a page that lacks a part does not open.
async function keep() {
  await navigator.serviceWorker.register("/sw.js");
  await navigator.serviceWorker.ready;
  const files = await (await fetch("/static/files.json")).json();
  await (await caches.open(SHELL)).addAll(["/", ...files]);
}

// A page that is not kept works as long as its node, which is what it did before.
if (navigator.serviceWorker && isSecureContext) keep().catch(() => {});
