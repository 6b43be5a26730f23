/* The SDK's headers include this file of the application; there is nothing to set. */
