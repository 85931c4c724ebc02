// Offline cache: in a secure context (https, or this machine) the browser keeps the page's files in case the node fails.
const SHELL = "swarm.shell";
// Load these modules early, so that they are available without the node.
for (const name of ["history", "invite", "phone"]) import(`./${name}.js`).catch(() => {});

// All files or none: an incomplete page does not start.
async function cacheFiles() {
  await navigator.serviceWorker.register("/sw.js");
  await navigator.serviceWorker.ready;
  const files = await (await fetch("/static/files.json")).json();
  await (await caches.open(SHELL)).addAll(["/", ...files]);
}

// Without a cache the page works while its node does.
if (navigator.serviceWorker && isSecureContext) cacheFiles().catch(() => {});
