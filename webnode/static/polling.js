// Polling: repeat a query only while its panel is in view.

// Call `work` every `every` milliseconds while `root` is in view; the returned function stops the calls.
export function pollWhileVisible(root, every, work) {
  let isVisible = false;
  let timer = null;

  function update() {
    clearTimeout(timer);
    timer = null;
    if (!isVisible || document.hidden) return;
    timer = setTimeout(update, every);
    work();
  }

  const observer = new IntersectionObserver(([entry]) => {
    isVisible = entry.isIntersecting;
    if (isVisible !== Boolean(timer)) update();
  });
  observer.observe(root);
  document.addEventListener("visibilitychange", update);
  return () => {
    isVisible = false;
    observer.disconnect();
    document.removeEventListener("visibilitychange", update);
    update();
  };
}
