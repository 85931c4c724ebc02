// The service worker: keeps the page's own files, so that it opens while its node is gone and finds another by itself.
// What the team says is never kept: no API, no stream, no picture.
const SHELL = "swarm.shell";
const PATIENCE = 1000;
const isShell = ({ pathname }) => pathname === "/" || pathname.startsWith("/static/");

addEventListener("install", () => skipWaiting());
addEventListener("activate", (event) => event.waitUntil(clients.claim()));

addEventListener("fetch", (event) => {
  const url = new URL(event.request.url);
  if (event.request.method !== "GET" || url.origin !== location.origin || !isShell(url)) return;
  event.respondWith(answer(event.request, url));
});

// The node's file where it comes in time, so that an update shows at once; else the one that is kept.  What is not
// kept yet is not kept here: the page keeps its files all at once, and half of them would open as half a page.
async function answer(request, url) {
  const shell = await caches.open(SHELL);
  const kept = await shell.match(url.pathname);
  if (!kept) return fetch(request);
  const fresh = fetch(request).then((told) => {
    if (told.ok) shell.put(url.pathname, told.clone());
    return told;
  });
  const late = new Promise((done) => setTimeout(done, PATIENCE, kept));
  return Promise.race([fresh.catch(() => kept), late]);
}
