// Polling: repeat a query only while its panel is in view.

// Call `work` every `every` milliseconds while `root` is in view; the returned function ends that.
export function watch(root, every, work) {
  let inSight = false;
  let timer = null;

  function turn() {
    clearTimeout(timer);
    timer = null;
    if (!inSight || document.hidden) return;
    timer = setTimeout(turn, every);
    work();
  }

  const eye = new IntersectionObserver(([entry]) => {
    inSight = entry.isIntersecting;
    if (inSight !== Boolean(timer)) turn();
  });
  eye.observe(root);
  document.addEventListener("visibilitychange", turn);
  return () => {
    inSight = false;
    eye.disconnect();
    document.removeEventListener("visibilitychange", turn);
    turn();
  };
}
