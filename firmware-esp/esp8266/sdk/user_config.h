/* Required by the SDK's headers; the bridge has no settings for it. */
