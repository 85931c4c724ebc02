// Keeping: where the browser allows it (https, or this machine) it keeps the page's files for when the node is gone.
const SHELL = "swarm.shell";

async function keep() {
  await navigator.serviceWorker.register("/sw.js");
  await navigator.serviceWorker.ready;
  const loaded = performance.getEntriesByType("resource").map((entry) => new URL(entry.name));
  const files = loaded.filter((url) => url.origin === location.origin && url.pathname.startsWith("/static/"));
  const shell = await caches.open(SHELL);
  await shell.addAll(["/", "/static/page.js", ...files.map((url) => url.pathname)].filter((each, n, all) => all.indexOf(each) === n));
}

// A page that is not kept works as long as its node, which is what it did before.
if (navigator.serviceWorker && isSecureContext) keep().catch(() => {});
