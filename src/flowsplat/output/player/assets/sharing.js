// The page on the whole screen, in another page, and passed on.

/** Whether it is shown in another page, without its controls: by its address, or that of the page of all shots round it. */
function isEmbedded() {
  return [window, window.parent].some((each) => {
    try {
      return each.location.hash === "#embed";
    } catch {
      return false;  // the page round it is of somebody else
    }
  });
}

/** Offer what this browser can do. */
function offerSharing(title) {
  const { fullscreen, share } = Object.fromEntries(["fullscreen", "share"].map((id) => [id, element(id)]));
  fullscreen.hidden = !document.fullscreenEnabled;
  fullscreen.onclick = () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  // A page on a disk has no address that others could open.
  share.hidden = !navigator.share || !location.protocol.startsWith("http");
  share.onclick = () => navigator.share({ title, url: location.href }).catch(() => {});  // the person thought better of it
}
