// Lets the search work where the pages are opened from disk. Browsers refuse a Worker there; a hidden frame does its work.
"use strict";

if (location.protocol === "file:") {
  const load = (scope, url) =>
    new Promise((done, failed) => {
      const script = scope.document.createElement("script");
      script.src = url;
      script.onload = () => done();
      script.onerror = () => failed(new Error(`${url} cannot be loaded`));
      scope.document.head.append(script);
    });

  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      this.scope = this.frame.contentWindow;
      // What the script of a worker finds around it.
      this.scope.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      this.scope.importScripts = (...urls) => urls.reduce((before, each) => before.then(() => load(this.scope, each)), Promise.resolve());
      this.ready = load(this.scope, url);
    }

    postMessage(data) {
      this.ready.then(() => this.scope.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {
      this.frame.remove();
    }
  };
}
