// Search in the pages as files: there a browser allows neither workers nor requests, so library and index come as scripts.
(function () {
  "use strict";
  var shortest = 2, excerpt = 200, loading = null;

  function load(name) {
    return new Promise(function (done, failed) {
      var script = document.createElement("script");
      script.src = base_url + "/search/" + name;
      script.onload = done;
      script.onerror = failed;
      document.head.appendChild(script);
    });
  }

  function ready() {
    loading = loading || Promise.all([load("lunr.js"), load("index.js")]).then(function () {
      lunr.tokenizer.separator = new RegExp(searchIndex.config.separator);
      return lunr(function () {
        this.field("title", { boost: 5 });
        this.field("text");
        this.ref("location");
        searchIndex.docs.forEach(function (page) { this.add(page); }, this);
      });
    });
    return loading;
  }

  function matches(index, words) {
    return index.query(function (query) {
      lunr.tokenizer(words).forEach(function (token) {
        var word = token.toString().replace(/^\W+|\W+$/g, "");
        if (!word) { return; }
        query.term(word, { boost: 10 });
        query.term(word, { wildcard: lunr.Query.wildcard.TRAILING });
      });
    });
  }

  function show(pages) {
    var found = document.getElementById("mkdocs-search-results");
    found.textContent = pages ? (pages.length ? "" : found.getAttribute("data-no-results-text")) : "";
    (pages || []).forEach(function (page) {
      var article = document.createElement("article"), heading = document.createElement("h3");
      var link = document.createElement("a"), text = document.createElement("p");
      link.href = base_url + "/" + page.location;
      link.textContent = page.title;
      text.textContent = page.text.substring(0, excerpt);
      heading.appendChild(link);
      article.append(heading, text);
      found.appendChild(article);
    });
  }

  function search() {
    var words = document.getElementById("mkdocs-search-query").value.trim();
    if (words.length < shortest) {
      show(null);
      return Promise.resolve();
    }
    return ready().then(function (index) {
      var pages = {};
      searchIndex.docs.forEach(function (page) { pages[page.location] = page; });
      show(matches(index, words).map(function (match) { return pages[match.ref]; }));
    });
  }

  document.addEventListener("DOMContentLoaded", function () {
    var input = document.getElementById("mkdocs-search-query");
    input.addEventListener("focus", ready);
    input.addEventListener("input", search);
  });
  window.searchPages = search;
})();
