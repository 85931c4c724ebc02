// Keeping: where the browser allows it (https, or this machine) it keeps the page's files for when the node is gone.
const SHELL = "swarm.shell";
const STYLES = ["/static/invite.css", "/static/phone.css"];
// What is asked for later comes in advance, so that it is there when its node is not.
const ahead = Promise.allSettled(["history", "invite", "phone"].map((name) => import(`./${name}.js`)));

async function keep() {
  await navigator.serviceWorker.register("/sw.js");
  await navigator.serviceWorker.ready;
  await ahead;
  const loaded = performance.getEntriesByType("resource").map((entry) => new URL(entry.name));
  const files = loaded.filter((url) => url.origin === location.origin && url.pathname.startsWith("/static/"));
  const shell = await caches.open(SHELL);
  await shell.addAll(["/", "/static/page.js", ...STYLES, ...files.map((url) => url.pathname)].filter((each, n, all) => all.indexOf(each) === n));
}

// A page that is not kept works as long as its node, which is what it did before.
if (navigator.serviceWorker && isSecureContext) keep().catch(() => {});
